"""`pathjax help`: the pages of the manual, `pathjax/manual/*.md`, in the terminal."""

from __future__ import annotations

import sys
from importlib import resources

from pathjax.cli import DONE
from pathjax.description.elements import nearest
from pathjax.errors import InputError
from pathjax.system.output import Output


def run(options, output: Output) -> int:
    """Show the page of a topic, rendered if stdout is a terminal; without a topic, list the pages.

    Raises:
        InputError: no page has this name; the message gives the nearest.
    """
    pages, topic = _pages(), options.topic
    if topic is None:
        width = max(map(len, pages))
        lines = [f"{name:<{width}}  {_summary(text)}" for name, text in pages.items()]
        output.text("\n".join(["The pages of the manual, which `pathjax help TOPIC` shows:", *lines]))
    elif topic not in pages:
        raise InputError(f'there is no page "{topic}"; use one of {", ".join(pages)}{nearest(topic, pages)}')
    elif sys.stdout is not None and sys.stdout.isatty():
        output.text(_rendered(pages[topic]))
    else:
        output.text(pages[topic].rstrip())
    return DONE


def _pages() -> dict[str, str]:
    """Return {topic: Markdown} in alphabetical order."""
    files = sorted((resources.files("pathjax") / "manual").iterdir(), key=lambda file: file.name)
    return {file.name.removesuffix(".md"): file.read_text(encoding="utf-8") for file in files}


def _summary(text: str) -> str:
    """Return the part of the first line, `# Title: summary`, after the colon."""
    return text.partition("\n")[0].partition(": ")[2]


def _rendered(text: str) -> str:
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    with console.capture() as capture:
        console.print(Markdown(text))
    return capture.get().rstrip()
