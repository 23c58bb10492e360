"""An HTML page to look at the results: tables, then grids of pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from cvthead.evaluation.shots import Image
from cvthead.images import encode_image

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 90rem; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0 }
td, th { padding: .2rem .6rem; text-align: right; border-bottom: 1px solid #ddd }
td:first-child, th:first-child { text-align: left }
.wide { overflow-x: auto }
.wide td, .wide th { padding: 2px; border: 0; text-align: center; font-size: 12px; color: #555 }
img { width: 160px; height: 160px; display: block }
"""


Rows = dict[str, Sequence[Image | None]]
"""Title -> one picture per column, None for an empty cell."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Pictures under a title.

    Attributes:
        columns: titles.
        rows: of the grid.
    """

    title: str
    columns: Sequence[str]
    rows: Mapping[str, Sequence[Image | None]]


def write_page(folder: Path, markdown: str, sections: Mapping[str, Sequence[Grid]]) -> Path:
    """Write ``index.html`` and its ``images`` to a folder, made if needed.

    Args:
        markdown: the report.
        sections: heading -> grids.

    Returns:
        The page.
    """
    parts = [
        "<!doctype html><meta charset=utf-8><title>Evaluation</title>",
        f"<style>{STYLE}</style><h1>Evaluation</h1>",
        tables(markdown),
    ]
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    for heading, grids in sections.items():
        if grids:
            parts.append(f"<h2>{escape(heading)}</h2>")
        parts += [
            grid_html(grid, images, f"{slug(heading)}-{number}")
            for number, grid in enumerate(grids)
        ]
    page = folder / "index.html"
    page.write_text("\n".join(parts), encoding="utf-8")
    return page


def grid_html(grid: Grid, images: Path, name: str) -> str:
    """The grid as a table; its pictures are written to ``images``, their names beginning with
    ``name``."""
    head = "".join(f"<th>{escape(title)}</th>" for title in grid.columns)
    rows = [
        f"<tr><th>{escape(title)}</th>"
        + "".join(
            f"<td>{img(images / f'{name}-{row}-{column}.jpg', picture)}</td>"
            for column, picture in enumerate(pictures)
        )
        + "</tr>"
        for row, (title, pictures) in enumerate(grid.rows.items())
    ]
    return (
        f"<h3>{escape(grid.title)}</h3><div class=wide><table><tr><th></th>{head}</tr>"
        + "".join(rows)
        + "</table></div>"
    )


def img(path: Path, picture: Image | None) -> str:
    """Save as JPEG and return the <img> element, empty for no picture."""
    if picture is None:
        return ""
    path.write_bytes(encode_image(picture, "jpeg"))
    place = escape(f"{path.parent.name}/{path.name}")
    return f'<img loading="lazy" src="{place}" alt="{escape(path.stem)}">'


def slug(title: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in title.lower())


def tables(markdown: str) -> str:
    """The report's Markdown (headings, paragraphs and tables only) as HTML."""
    out: list[str] = []
    for block in markdown.strip().split("\n\n"):
        lines = block.split("\n")
        if not lines[0].startswith("|"):
            title = block.removeprefix("## ")
            out.append(f"<p>{escape(block)}</p>" if title == block else f"<h2>{escape(title)}</h2>")
            continue
        cells = [[escape(c.strip()) for c in line.strip("|").split("|")] for line in lines]
        out.append("<table><tr>" + "".join(f"<th>{c}</th>" for c in cells[0]) + "</tr>")
        out += ["<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in cells[2:]]
        out.append("</table>")
    return "\n".join(out)
