"""An HTML page to look at the results: people, drivers, results, and a sweep of poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from cvthead.evaluation.metrics import on_white
from cvthead.evaluation.protocol import BALD, MESH, OURS, Clip, Image, Reenactment
from cvthead.evaluation.report import Report
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

SHOWN = {"driver": None, OURS: OURS, MESH: MESH, BALD: BALD}


@dataclass(frozen=True)
class Album:
    """Writes pictures beside the page."""

    folder: Path

    def img(self, name: str, picture: Image) -> str:
        """Save as JPEG and return the <img> element; ``name`` is unique and fit for a file."""
        path = self.folder / f"{name}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_image(picture, "jpeg"))
        place = f"{self.folder.name}/{path.name}"
        return f'<img loading="lazy" src="{escape(place)}" alt="{escape(name)}">'


def write_page(
    folder: Path,
    report: Report,
    clips: Sequence[Clip],
    sweeps: Mapping[str, Mapping[str, Image]],
    shown: int = 4,
) -> Path:
    """Write ``index.html`` and its ``images``.

    Args:
        folder: made if needed.
        clips: people to show.
        sweeps: by clip name, title -> picture; all with the same titles.
        shown: at most so many driving frames of each clip.

    Returns:
        The page.
    """
    album = Album(folder / "images")
    parts = [
        "<!doctype html><meta charset=utf-8><title>Evaluation</title>",
        f"<style>{STYLE}</style><h1>Self-reenactment</h1>",
        tables(report.markdown()),
        "<h2>People</h2>",
    ]
    parts += [person(clip, album, shown) for clip in clips]
    if sweeps:
        titles = list(next(iter(sweeps.values())))
        head = "".join(f"<th>{escape(title)}</th>" for title in titles)
        rows = [
            "<tr>"
            + "".join(
                f"<td>{album.img(f'{name}-sweep-{i}', pictures[title])}</td>"
                for i, title in enumerate(titles)
            )
            + "</tr>"
            for name, pictures in sweeps.items()
        ]
        parts.append(
            f"<h2>Sweep</h2><div class=wide><table><tr>{head}</tr>{''.join(rows)}</table></div>"
        )
    page = folder / "index.html"
    page.write_text("\n".join(parts), encoding="utf-8")
    return page


def person(clip: Clip, album: Album, shown: int) -> str:
    """One clip: the source, then a row per method under the drivers."""
    step = np.linspace(0, len(clip.drivers) - 1, min(shown, len(clip.drivers))).round()
    drivers = [clip.drivers[int(i)] for i in step]
    source = album.img(f"{clip.name}-source", picture_on_white(clip.source.image, clip.source.mask))
    rows = []
    for title, method in SHOWN.items():
        cells = [
            f"<td>{album.img(f'{clip.name}-{d.frame}-{slug(title)}', row_picture(d, method))}</td>"
            for d in drivers
        ]
        first = f"<td>{source}</td>" if method is None else "<td></td>"
        rows.append(f"<tr><th>{escape(title)}</th>{first}{''.join(cells)}</tr>")
    marks = "".join(f"<th>frame {d.frame}, {d.scores[OURS].psnr:.1f} dB</th>" for d in drivers)
    return (
        f"<h3>{escape(clip.name)}</h3><div class=wide><table>"
        f"<tr><th></th><th>source</th>{marks}</tr>{''.join(rows)}</table></div>"
    )


def row_picture(driven: Reenactment, method: str | None) -> Image:
    if method is None:
        return picture_on_white(driven.target.image, driven.target.mask)
    return picture_on_white(driven.drawn[method].rgb, driven.drawn[method].alpha)


def picture_on_white(image: Image, mask: np.ndarray) -> Image:
    return (on_white(image, mask) * 255).round().astype(np.uint8)


def slug(title: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in title.lower())


def tables(markdown: str) -> str:
    """The report's Markdown (paragraphs and tables only) as HTML."""
    out: list[str] = []
    for block in markdown.strip().split("\n\n"):
        lines = block.split("\n")
        if not lines[0].startswith("|"):
            out.append(f"<p>{escape(block)}</p>")
            continue
        cells = [[escape(c.strip()) for c in line.strip("|").split("|")] for line in lines]
        out.append("<table><tr>" + "".join(f"<th>{c}</th>" for c in cells[0]) + "</tr>")
        out += ["<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in cells[2:]]
        out.append("</table>")
    return "\n".join(out)
