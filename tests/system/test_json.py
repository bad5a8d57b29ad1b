"""Results are strict JSON, whatever numbers they hold."""

import json
import math

import numpy as np

from pathjax.system.json_text import json_text


def test_what_json_has_no_word_for_is_null():
    assert json_text({"a": math.nan, "b": [math.inf, (-math.inf, 1.5)], "c": None}) == (
        '{"a": null, "b": [null, [null, 1.5]], "c": null}'
    )


def test_arrays_and_numbers_of_numpy_are_lists_and_numbers():
    values = {"array": np.array([[1.0, np.nan], [np.inf, 2.0]]), "real": np.float32(0.5), "whole": np.int32(3)}
    values |= {"true": np.bool_(True), "empty": np.zeros((0, 3))}
    assert json.loads(json_text(values)) == {
        "array": [[1, None], [None, 2]],
        "real": 0.5,
        "whole": 3,
        "true": True,
        "empty": [],
    }


def test_text_and_layout_are_those_of_json():
    assert json_text({"a": ["b\ud800"]}, indent=1) == json.dumps({"a": ["b\ud800"]}, indent=1)
