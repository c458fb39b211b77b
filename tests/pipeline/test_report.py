"""`dope prep report`: what is in the page, and what a real browser makes of it."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from browser import Opened, open_page
from prepared_files import STAGES, write_files, write_marker
from synthetic import Scene, orbit, write_sequence
from typer.testing import CliRunner

import cli
from dope.common.errors import BadInput, UsageError
from pipeline.report.histograms import PLOTS, histogram
from pipeline.report.orbit import orbit_of, read_point_cloud
from pipeline.report.page import ReportConfig, write_report
from pipeline.report.sheet import DETAILS, build_sheet
from pipeline.report.status_table import read_status
from pipeline.sequence import Sequence, write_image

SHELL = re.compile(r'<script type="application/json" id="(?:d\d+|index)">(.*?)</script>', re.DOTALL)
HOSTILE = (
    "<img src=x onerror=document.title='pwned'>",
    "</script><script>document.title='pwned'</script>",
    "\"'><svg onload=document.title='pwned'>",
    "a\nb <!--<script>",
    "&lt;b&gt; \u2028 漢字 ${where} $style",
)


def write_points(path: Path, xyz: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    points = (struct.pack("<Q3d3BdQ", i, *p, 200, 100, 50, 0.5, 2) + bytes(16) for i, p in enumerate(xyz.tolist()))
    path.write_bytes(struct.pack("<Q", len(xyz)) + b"".join(points))


def finish(sequence: Sequence) -> None:
    """What the stages would have left: markers, sparse points, views and pairs."""
    info = sequence.read_info()
    info.attempts = [{"rung": "default", "mapper": "strict", "n_frames": 6, "n_registered": 6, "verdict": "sensible"}]
    sequence.write_info(info)
    for stage in STAGES:
        write_marker(sequence.folder, stage)
    rng = np.random.default_rng(0)
    write_points(sequence.sparse / "points3D.bin", rng.normal(size=(300, 3)) * 0.5)
    for frame in (0, 3):
        write_image(sequence.views / f"{frame:06d}.jpg", rng.integers(0, 255, (224, 224, 3), np.uint8))
    row = {"frame1": 0, "frame2": 3, "angle_deg": 41.0, "overlap": 0.5, "n_correspondences": 40,
           "points": rng.uniform(5, 219, 160).astype(np.float32)}  # fmt: skip
    pq.write_table(pa.Table.from_pylist([row]), sequence.correspondences)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    sequence = write_sequence(tmp_path_factory.mktemp("rendered") / "ball", orbit(6, width=160, height=120), Scene())
    finish(sequence)
    return sequence


@pytest.fixture
def work(rendered: Sequence, tmp_path: Path) -> Path:
    """A finished sequence, one of frames only, and two that failed."""
    work = tmp_path / "work"
    shutil.copytree(rendered.folder, work / "ball")
    write_files(work / "half", 1, category="bowl", attempts=[])
    write_files(work / "bad_1", 1, failed="only 3 of 50 frames register")
    write_files(work / "bad_2", 1, failed="only 7 of 50 frames register")
    return work


def write_page(work: Path, out: Path, **settings: Any) -> str:
    write_report(read_status([work]), out, ReportConfig(**settings))
    return out.read_text(encoding="utf-8")


def sheet_of(work: Path, name: str, limit: int = 10**6) -> dict[str, Any]:
    row = next(row for row in read_status([work]).to_pylist() if row["id"] == name)
    return json.loads(build_sheet(row, limit)[0])


def shown(page: Path, address: str = "") -> Opened:
    """In a window that is so high that every sheet is near it, whatever fonts the machine has."""
    return open_page(page, address, profile=page.parent / "profile", height=9000)


def test_a_browser_shows_every_sequence_and_complains_of_nothing(work: Path, tmp_path: Path) -> None:
    write_page(work, tmp_path / "report.html", title="Cups & bowls")
    page = shown(tmp_path / "report.html")
    assert page.complaints == []
    assert page.title == "Cups &amp; bowls: 1 ok, 1 waiting, 2 failed"
    assert page.rows == ["bad_1", "bad_2", "ball", "half"] and page.count == "4 sequences"
    assert 'data-rows="4"' in page.dom and re.search(r'data-milliseconds="\d+"', page.dom)
    page = shown(tmp_path / "report.html", "#s2")  # asked for, a sheet is filled at once; others when they come near
    assert page.complaints == []
    ball = page.dom.partition('id="s2"')[2].partition("</article>")[0]
    assert ball.count('class="edge"') == ball.count('alt="Depth of frame') == 6
    assert ball.count('class="frustum"') == 6 and ball.count("<line ") == 18 and ball.count("<image ") == 8
    assert "6 cameras around" in ball and "41° apart, 50% overlap, 40 correspondences" in ball
    assert "2 models were found" in ball and "sensible" in ball


@pytest.mark.parametrize(
    ("address", "rows"),
    [
        ("#?status=failed", ["bad_1", "bad_2"]),
        ("#?q=7%20OF", ["bad_2"]),
        ("#?category=bowl", ["half"]),
        ("#?sort=-id", ["half", "ball", "bad_2", "bad_1"]),
        ("#?status=%3Cb%3E&sort=__proto__&q=", ["bad_1", "bad_2", "ball", "half"]),
    ],
)
def test_the_address_filters_and_sorts(address: str, rows: list[str], work: Path, tmp_path: Path) -> None:
    write_page(work, tmp_path / "report.html")
    page = shown(tmp_path / "report.html", address)
    assert page.rows == rows and page.complaints == []
    assert page.count == ("4 sequences" if len(rows) == 4 else f"{len(rows)} of 4 sequences")


def test_hostile_names_are_shown_and_never_executed(tmp_path: Path) -> None:
    work = tmp_path / "work"
    for number, text in enumerate(HOSTILE):
        name = text.replace("/", "∕")
        folder = write_files(
            work / f"{number}{name}", 1, failed=f"{text}: broken", category=text, source=text, kind=text
        )
        info = json.loads((folder / "sequence.json").read_text())
        (folder / "sequence.json").write_text(json.dumps(info | {"attempts": [{"rung": text, "verdict": text}]}))
        write_marker(folder, "frames", warnings=[text])
    text = write_page(work, tmp_path / "report.html", title=HOSTILE[1])
    assert text.count("</script>") == 2 + len(HOSTILE) and text.count("<script") == 2 + len(HOSTILE)
    page = shown(tmp_path / "report.html")
    assert page.title.startswith("&lt;/script&gt;&lt;script&gt;") and len(page.rows) == len(HOSTILE)
    assert page.complaints == [], "the policy had to stop what should have been text"
    assert "&lt;img src=x" in page.rows[0]


def test_the_policy_stops_a_script_that_got_in_all_the_same(work: Path, tmp_path: Path) -> None:
    text = write_page(work, tmp_path / "report.html")
    inside = "<main><img src=x onerror=\"document.title='pwned'\"><script>document.title='pwned'</script>"
    (tmp_path / "report.html").write_text(text.replace("<main>", inside, 1))
    page = shown(tmp_path / "report.html")
    assert "pwned" not in page.title and any("Content Security Policy" in line for line in page.complaints)


def test_the_page_loads_nothing_from_anywhere(work: Path, tmp_path: Path) -> None:
    text = write_page(work, tmp_path / "report.html")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy and policy[1].startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy[1] and not re.search(r'(src|href)="(?!#)', SHELL.sub("", text))
    assert re.findall(r"https?://[^\s'\"]+", text) == ["http://www.w3.org/2000/svg"]


def test_failures_come_first_and_like_reasons_together(work: Path, tmp_path: Path) -> None:
    text = write_page(work, tmp_path / "report.html")
    assert text.index("2 sequences failed") < text.index("Over the set") < text.index('id="table"')
    reasons = text.partition('<ul class="reasons">')[2].partition("</section>")[0]
    assert reasons.count('<span class="n">') == 1 and "only N of N frames register" in reasons
    assert "only 3 of 50 frames register" in reasons and "only 7 of 50 frames register" in reasons


def test_the_same_input_gives_the_same_bytes(work: Path, tmp_path: Path) -> None:
    assert write_page(work, tmp_path / "1.html", workers=3) == write_page(work, tmp_path / "2.html", workers=1)


def test_an_empty_work_is_a_page_too(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    write_page(tmp_path / "work", tmp_path / "report.html")
    page = shown(tmp_path / "report.html")
    assert page.count == "0 sequences" and page.complaints == []


def test_a_thousand_sequences_stay_within_the_bound_and_open(rendered: Sequence, tmp_path: Path) -> None:
    write_files(tmp_path / "work/any")
    (row,) = read_status([tmp_path / "work"]).to_pylist()
    rows = [row | {"id": "ball", "work": str(rendered.folder.parent), "category": f"kind {i % 9}"} for i in range(1000)]
    for row in rows[::100]:
        row |= {"status": "failed", "stage": "sfm", "reason": "too dark"}
    table = pa.Table.from_pylist(rows, schema=read_status([tmp_path / "work"]).schema)
    details = write_report(table, tmp_path / "report.html", ReportConfig(max_mb=4.0))
    assert details["bytes"] <= 4_000_000 and 0 < details["without_pictures"] < 1000
    text = (tmp_path / "report.html").read_text()
    failed = json.loads(SHELL.findall(text)[1])
    assert failed["frames"], "what failed has pictures first"
    page = shown(tmp_path / "report.html", "#?status=failed")
    assert len(page.rows) == 10 and page.count == "10 of 1,000 sequences" and page.complaints == []
    assert f"{details['without_pictures']} of 1,000 sequences are shown without pictures" in page.dom


@pytest.mark.parametrize("max_mb", [0.02, 0.0, -1.0, float("nan"), float("inf")])
def test_a_bound_that_cannot_be_kept_is_refused(max_mb: float, work: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--max-mb"):
        write_page(work, tmp_path / "report.html", max_mb=max_mb)
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize("limit", [10**6, 150_000, 40_000, 20_000, 9_000, 3_000, 50])
def test_a_sheet_never_exceeds_its_bytes(limit: int, rendered: Sequence) -> None:
    (row,) = read_status([rendered.folder.parent]).to_pylist()
    text, level = build_sheet(row, limit)
    assert len(text) <= limit and (level < len(DETAILS)) == bool(json.loads(text).get("frames"))


def test_outlines_lie_on_the_masks_and_depth_is_measured(rendered: Sequence) -> None:
    sheet = sheet_of(rendered.folder.parent, "ball")
    frame = rendered.read_frames()[0]
    mask = rendered.read_mask(frame)
    assert mask is not None
    corners = np.array([pair.split() for pair in re.split("[MLZ]+", sheet["frames"][0]["mask"]) if pair], dtype=float)
    v, u = np.nonzero(mask)
    for k, (axis, size) in enumerate(((u, 160), (v, 120))):
        ends = corners[:, k].min() * size / 1000, corners[:, k].max() * size / 1000
        assert np.allclose(ends, (axis.min(), axis.max() + 1), atol=1.0)
    near, far = sheet["range"]
    depth = np.concatenate([rendered.read_depth(f).ravel() for f in rendered.read_frames()])  # type: ignore[union-attr]
    assert np.allclose((near, far), np.quantile(depth[depth > 0], (0.01, 0.99)), rtol=0.01)


def test_the_orbit_is_upright_and_keeps_its_shape(rendered: Sequence) -> None:
    import base64

    frames = rendered.read_frames()
    drawn = orbit_of(frames, rendered.sparse, 100, 50)
    assert drawn is not None and drawn["n"] == 6 and len(base64.b64decode(drawn["points"])) == 300
    poses = np.frombuffer(base64.b64decode(drawn["cameras"]), "<i2").reshape(6, 9) / 32767
    centres = np.array([frame.camera.centre for frame in frames])
    lengths = np.linalg.norm(centres[:, None] - centres, axis=2)
    assert np.allclose(np.linalg.norm(poses[:, None, :3] - poses[:, :3], axis=2) * drawn["extent"], lengths, atol=2e-3)
    assert np.allclose(poses[:, 2] * drawn["extent"], centres[:, 2], atol=0.35)  # the scene's up is z


def test_damaged_files_are_notes_in_the_sheet(work: Path) -> None:
    ball = work / "ball"
    (ball / "images/000000.jpg").write_bytes(b"no picture")
    (ball / "masks/000001.png").unlink()
    os.mkfifo(ball / "masks/000001.png")
    (ball / "depths/000002.png").write_bytes(b"")
    (ball / "sparse/points3D.bin").write_bytes(struct.pack("<Q", 2**62) + bytes(30))
    (ball / "views/000003.jpg").unlink()
    sheet = sheet_of(work, "ball")
    assert [frame["frame"] for frame in sheet["frames"]] == [1, 2, 3, 4, 5]
    assert sheet["frames"][0]["mask"] is None and "depth" not in sheet["frames"][1] and sheet["orbit"] is None
    assert len(sheet["notes"]) == 5 and all(str(ball) in note for note in sheet["notes"])
    sequence = Sequence(ball)
    frames = sequence.read_frames()
    frames[4].depth_scale = float("inf")
    sequence.write_frames(frames)
    sheet = sheet_of(work, "ball")
    assert "depth" not in sheet["frames"][3] and any("depth_scale is inf" in note for note in sheet["notes"])
    (ball / "frames.parquet").write_bytes(b"PAR1")
    assert "frames.parquet" in sheet_of(work, "ball")["notes"][0]


def test_files_outside_the_sequence_are_not_shown(work: Path) -> None:
    sequence = Sequence(work / "ball")
    frames = sequence.read_frames()
    write_image(work / "secret.jpg", np.full((120, 160, 3), 77, np.uint8))
    frames[0].image, frames[1].mask, frames[2].depth = "../secret.jpg", str(work / "secret.jpg"), "images/../../x.png"
    sequence.write_frames(frames)
    sheet = sheet_of(work, "ball")
    assert [frame["frame"] for frame in sheet["frames"]] == [1, 2, 3, 4, 5]
    assert sheet["frames"][0]["mask"] is None and len(sheet["notes"]) == 3


def test_points_without_a_model_are_none_and_a_cut_file_is_named(tmp_path: Path) -> None:
    assert len(read_point_cloud(tmp_path)[0]) == 0
    xyz = np.arange(30.0).reshape(10, 3)
    write_points(tmp_path / "points3D.bin", xyz)
    found, rgb = read_point_cloud(tmp_path)
    assert np.array_equal(found, xyz) and rgb[4].tolist() == [200, 100, 50]
    (tmp_path / "points3D.bin").write_bytes((tmp_path / "points3D.bin").read_bytes()[:-40])
    with pytest.raises(BadInput, match=r"points3D\.bin"):
        read_point_cloud(tmp_path)


@pytest.mark.parametrize("values", [[0.5], [1.0] * 9, [0.0, 0.0], [1e-9, 1e9], [-3.0, -2.0], list(range(1000))])
@pytest.mark.parametrize("plot", PLOTS[:2])
def test_histograms_count_every_value_once(plot: Any, values: list[float]) -> None:
    drawn = histogram(plot, np.array(values))
    counts = [int(text.replace(",", "")) for text in re.findall(r": ([\d,]+)</title>", drawn)]
    assert sum(counts) == len(values) and "nan" not in drawn and "inf" not in drawn


def test_the_command_writes_the_page(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    words = ["prep", "report", str(work), "--out", str(out), "--where", "status=failed"]
    answer = CliRunner().invoke(cli.app, words, catch_exceptions=False)
    assert answer.exit_code == 0 and "2 sequences" in answer.stdout
    assert out.read_text().count('<th scope="row">') == 2
    for wrong in (["prep", "report", str(tmp_path / "gone")], ["prep", "report", str(work), "--out", str(work)]):
        with pytest.raises(UsageError):
            CliRunner().invoke(cli.app, wrong, catch_exceptions=False)
