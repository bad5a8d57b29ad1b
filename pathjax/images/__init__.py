"""Image files, and comparison of images.

Images are (H, W, 3) linear RGB with the primaries of Rec. 709, the top row first. OpenEXR is for measurement, PNG for
viewing. A file that cannot be read or written raises an `InputError` that names it.
"""

from pathjax.images.comparison import Comparison, compare
from pathjax.images.decoder import file_format
from pathjax.images.exr import read_exr, write_exr
from pathjax.images.metrics import flip, level, mse, psnr, rel_mse, relative_error, z_scores
from pathjax.images.png import linear_to_srgb, srgb_to_linear, write_png
from pathjax.images.read import read_rgb

__all__ = [
    "Comparison",
    "compare",
    "file_format",
    "flip",
    "level",
    "linear_to_srgb",
    "mse",
    "psnr",
    "read_exr",
    "read_rgb",
    "rel_mse",
    "relative_error",
    "srgb_to_linear",
    "write_exr",
    "write_png",
    "z_scores",
]
