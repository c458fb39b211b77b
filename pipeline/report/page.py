"""The report: one HTML file with everything in it, its size bounded, nothing in it loaded from elsewhere.

Names, reasons and file names come from strangers' disks. They are escaped where they stand in HTML; what the script
shows is JSON in inert elements, put into the page as text. A content security policy allows this page's own script and
style by their hashes, and nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import pyarrow as pa

import dope
from dope.common import files
from dope.common.errors import UsageError
from pipeline.report import blocks
from pipeline.report.histograms import PLOTS, finite, histogram
from pipeline.report.sheet import DETAILS, as_json, build_sheet
from pipeline.report.status_row import STAGES

WORDS_BYTES = 800
"""Room for a sheet without pictures."""
SHELL = '<script type="application/json" id="d{}">{}</script>\n'
LONGEST = 2000
"""Characters of a reason or warning that the page repeats."""
INDEX = (
    "id", "status", "stage", "reason", "category", "instance", "source", *(f"stage_{name}" for name in STAGES),
    "frames", "kept", "registered", "registered_share", "error_px", "points", "depth_coverage", "depth_error", "masks",
    "masks_flagged", "masks_from", "views", "pairs", "correspondences", "cpu_seconds", "warning_texts",
)  # fmt: skip
"""The columns that the page's script knows."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class ReportConfig:
    """Settings of `dope prep report`."""

    title: str = "Prepared sequences"
    """Heading of the page."""
    max_mb: float = 48.0
    """Largest size of the page in MB: the more sequences, the fewer and smaller their pictures."""
    workers: int = 1
    """Threads that make pictures."""


def write_report(table: pa.Table, out: Path, config: ReportConfig, progress: Progress | None = None) -> dict[str, Any]:
    """Write the page for the rows of a status table.

    Returns:
        {"sequences", "bytes", "without_pictures"}.

    Raises:
        UsageError: `max_mb` is no size, or the table alone is larger.
        DiskFull: no room for the page.
    """
    if not 0 < config.max_mb < math.inf:
        raise UsageError("is not a size in MB", where=f"--max-mb {config.max_mb}")
    report = progress or (lambda what, done, of: None)
    rows = [_shortened(row) for row in table.to_pylist()]
    categories = any(row["category"] for row in rows)
    script, style = _resource("script.js"), _resource("style.css")
    words = {
        "title": escape(f"{config.title}: {blocks.outcome(rows)}"),
        "heading": escape(config.title),
        "where": escape(", ".join(dict.fromkeys(row["work"] or "" for row in rows))),
        "tiles": blocks.tiles(rows),
        "failures": blocks.failures(rows),
        "plots": "\n".join(filter(None, (histogram(plot, finite(table[plot.column])) for plot in PLOTS))),
        "columns": blocks.table_head(categories),
        "rows": "\n".join(blocks.table_row(number, row, categories) for number, row in enumerate(rows)),
        "count": f"{len(rows):,}",
        "index": as_json({"keys": INDEX, "stages": STAGES, "rows": [[row[key] for key in INDEX] for row in rows]}),
        "version": escape(dope.__version__),
        "style": style,
        "style_hash": _hash(style),
        "script_hash": _hash(script),
    }
    page = Template(_resource("page.html"))
    tail = f"<script>{script}</script>\n</body>\n</html>\n"
    fixed = len(page.substitute(words, bound=" " * 400).encode()) + len(tail)
    limits = _limits(rows, round(config.max_mb * 1e6) - fixed, config)
    sheets: list[tuple[str, int]] = []
    with ThreadPoolExecutor(max(1, config.workers)) as pool:
        for sheet in pool.map(build_sheet, rows, limits):
            sheets.append(sheet)
            report("contact sheets", len(sheets), len(rows))
    levels = [level for _, level in sheets]
    with files.atomic_path(out) as partial_path, partial_path.open("w", encoding="utf-8") as file:
        file.write(page.substitute(words, bound=escape(_bound(levels, rows, config))))
        file.writelines(SHELL.format(number, text) for number, (text, _) in enumerate(sheets))
        file.write(tail)
    without = sum(level == len(DETAILS) for level in levels)
    return {"sequences": len(rows), "bytes": out.stat().st_size, "without_pictures": without}


def _limits(rows: list[dict[str, Any]], room: int, config: ReportConfig) -> list[int]:
    """Bytes for the sheet of each row. Where not all can have pictures, failures do first, then every k-th."""
    n, smallest = len(rows), DETAILS[-1].usual_bytes
    room -= n * len(SHELL.format(n, ""))
    if room < n * 2:
        raise UsageError(
            f"the figures of {n:,} sequences alone are larger than {config.max_mb:g} MB",
            where="--max-mb",
            remedy="Allow more, or choose sequences with --where",
        )
    if room >= n * smallest:
        return [min(room // max(1, n), 2 * DETAILS[0].usual_bytes)] * n
    spare = min(WORDS_BYTES, room // (2 * n))
    some = (room - n * spare) // smallest
    first = [i for i, row in enumerate(rows) if row["status"] in ("failed", "empty")]
    others = [i for i, row in enumerate(rows) if row["status"] not in ("failed", "empty")]
    chosen = set(first[:some])
    left = some - len(chosen)
    if left:
        chosen |= {others[i * len(others) // left] for i in range(min(left, len(others)))}
    return [smallest if i in chosen else spare for i in range(n)]


def _bound(levels: list[int], rows: list[dict[str, Any]], config: ReportConfig) -> str:
    """What the size limit costs, in words."""
    used = [DETAILS[level] for level in levels if level < len(DETAILS)]
    missing = len(levels) - len(used)
    limit = f"this page stays under {config.max_mb:g} MB (--max-mb)"
    if not used:
        return f"No pictures, so that {limit}." if rows else "There is nothing here yet."
    least, most = min(used, key=lambda detail: detail.side), max(used, key=lambda detail: detail.side)
    sizes = f"{least.side}" if least == most else f"{least.side} to {most.side}"
    counts = f"{least.frames}" if least == most else f"{least.frames} to {most.frames}"
    text = f"Up to {counts} frames of {sizes} pixels a sequence, so that {limit}."
    return text + (f" {missing:,} of {len(levels):,} sequences are shown without pictures." if missing else "")


def _shortened(row: dict[str, Any]) -> dict[str, Any]:
    whole = ("id", "work")
    return {k: v[:LONGEST] if isinstance(v, str) and k not in whole else v for k, v in row.items()}


def _resource(name: str) -> str:
    return (resources.files("pipeline.report") / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
