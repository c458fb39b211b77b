"""Blender's process crashes, hangs, talks nonsense or is not there: one object is lost, with its reason."""

from __future__ import annotations

import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dope.common.errors import BadInput, DopeError
from pipeline.children import Limits
from pipeline.render.config import CyclesConfig
from pipeline.render.cycles import process, renderer
from pipeline.render.cycles.exr import read_exr
from pipeline.render.cycles.folders import PrivateFolder
from pipeline.render.cycles.renderer import CyclesRenderer
from pipeline.render.exposure import expose, show, white_under
from pipeline.render.scene import Part
from tests.pipeline.fake_blender import MISDEEDS
from tests.pipeline.render_scenes import box, even_light, look_at, small_scene

TINY = look_at(0.3, 1.0, 2.5, size=(4, 3))
HERE = CyclesConfig(python=sys.executable)


def write_exr(path: Path, channels: dict[str, np.ndarray], *, compression: int = 0, version: int = 2) -> None:
    """An EXR file of 32-bit channels as the format's document has it."""
    height, width = next(iter(channels.values())).shape
    names = sorted(channels)
    listed = b"".join(name.encode() + b"\0" + struct.pack("<4i", 2, 0, 1, 1) for name in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = struct.pack("<ii", 20000630, version)
    for name, kind, value in [
        ("channels", "chlist", listed),
        ("compression", "compression", bytes([compression])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
    ]:
        header += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    header += b"\0"
    size = 4 * width * len(names)
    offsets = [len(header) + 8 * height + y * (8 + size) for y in range(height)]
    rows = [
        struct.pack("<ii", y, size) + b"".join(channels[name][y].astype("<f4").tobytes() for name in names)
        for y in range(height)
    ]
    path.write_bytes(header + struct.pack(f"<{height}Q", *offsets) + b"".join(rows))


def passes() -> dict[str, np.ndarray]:
    """What Blender writes for a picture of 4 x 3."""
    rng = np.random.default_rng(0)
    channels = {f"ViewLayer.Combined.{name}": rng.uniform(0, 1.2, (3, 4)) for name in "RGBA"}
    channels["ViewLayer.Depth.Z"] = np.array([[1e10] * 4, [2, 3, 4, 5], [1, 1, 1, 1.5]])
    channels["ViewLayer.IndexOB.X"] = np.array([[0] * 4, [1, 1, 2, 2], [2, 2, 1, 0]])
    return channels


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a worker that is the fake."""
    shutil.copy(Path(__file__).with_name("fake_blender.py"), tmp_path / "worker.py")
    write_exr(tmp_path / "picture.exr", passes())
    monkeypatch.setattr(process, "WORKER", tmp_path / "worker.py")
    return tmp_path


@pytest.fixture
def blender(fake: Path):
    rendering = CyclesRenderer(HERE, Limits(minutes=0.02))
    yield rendering
    rendering.close()


def test_a_picture_is_read_from_its_passes(blender: CyclesRenderer) -> None:
    (picture,) = blender.render(small_scene(TINY))
    channels = passes()
    assert blender.version.endswith("Blender 0.0 fake")
    np.testing.assert_array_equal(picture.mask, channels["ViewLayer.IndexOB.X"] == 1)
    np.testing.assert_array_equal(picture.depth, [[0] * 4, [2, 3, 4, 5], [1, 1, 1, 1.5]])
    radiance = np.stack([channels[f"ViewLayer.Combined.{name}"] for name in "RGB"], axis=-1).astype(np.float32)
    np.testing.assert_array_equal(
        picture.image, show(radiance, expose(white_under(even_light(), None), None, 0.65).balance)
    )
    assert (picture.image.dtype, picture.mask.dtype, picture.depth.dtype) == (np.uint8, bool, np.float32)


@pytest.mark.parametrize(
    ("misdeed", "reason"),
    [
        ("crash", "ended by SIGSEGV; it last said: what the crash was about"),
        ("leave", "ended with exit code 3"),
        ("hang", r"longer than the object's 0\.02 minutes.*cycles\.samples"),
        ("garbage", "makes no sense"),
        ("twice", "makes no sense"),
        ("list", "makes no sense"),
        ("other", "makes no sense"),
        ("no_file", "picture cannot be read"),
        ("half_file", "picture cannot be read: ends after"),
        ("complain", "could not render it: ValueError: no such thing"),
        ("deaf", "stopped answering|longer than"),
    ],
)
def test_misdeeds_cost_their_object_only(blender: CyclesRenderer, misdeed: str, reason: str) -> None:
    expected = next(blender.render(small_scene(TINY)))
    with pytest.raises(BadInput, match=reason):
        for _ in blender.render(small_scene(TINY, TINY, seed=MISDEEDS.index(misdeed))):
            pass
    (picture,) = blender.render(small_scene(TINY))
    np.testing.assert_array_equal(picture.image, expected.image)


def test_what_an_object_made_blender_say_is_not_told_of_the_next(blender: CyclesRenderer) -> None:
    for misdeed, said in (("crash", "what the crash"), ("leave", "code 3$")):
        with pytest.raises(BadInput, match=said):
            list(blender.render(small_scene(TINY, seed=MISDEEDS.index(misdeed))))


def test_a_picture_of_another_size_is_refused(blender: CyclesRenderer) -> None:
    with pytest.raises(BadInput, match="is 4x3"):
        list(blender.render(small_scene(look_at(0.3, 1.0, 2.5, size=(5, 3)))))


def test_a_view_that_was_not_waited_for_is_not_taken_for_another(blender: CyclesRenderer) -> None:
    views = blender.render(small_scene(TINY, TINY))
    next(views)
    assert len(list(blender.render(small_scene(TINY)))) == 1
    with pytest.raises(RuntimeError, match="another scene"):
        next(views)


def test_a_process_is_replaced_after_so_many_objects_and_when_it_has_died(
    blender: CyclesRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(renderer, "REUSE", 2)
    pids = []
    for number in range(5):
        assert len(list(blender.render(small_scene(TINY)))) == 1
        pids.append(blender._process._process.pid)
        if number == 2:
            os.kill(pids[-1], signal.SIGKILL)
            blender._process._process.wait()
    assert [a == b for a, b in pairwise(pids)] == [True, False, False, True]


def test_arrays_that_would_crash_blender_are_refused(blender: CyclesRenderer) -> None:
    good = box()
    with pytest.raises(BadInput, match="faces of vertices that it does not have"):
        next(blender.render(small_scene(TINY, part=Part(good.vertices, good.faces + 1))))
    with pytest.raises(BadInput, match="0: vertices has numbers that are not finite"):
        next(blender.render(small_scene(TINY, part=Part(good.vertices * np.nan, good.faces))))


def test_closing_ends_the_process_and_leaves_nothing(fake: Path) -> None:
    rendering = CyclesRenderer(HERE)
    pid, folder = rendering._process._process.pid, rendering._folder.path
    assert folder.exists()
    rendering.close()
    assert not folder.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_no_blender_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(process.VARIABLE, raising=False)
    how = r"venv bpyenv && bpyenv/bin/pip install 'bpy==4\.5\.\*' 'numpy<2'.*--set cycles\.python"
    with pytest.raises(DopeError, match=f"absent: cycles.python is not an interpreter.*{how}"):
        CyclesRenderer(CyclesConfig(python=str(tmp_path / "absent")))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DopeError, match=f"needs Blender's Python package bpy.*{how}"):
        CyclesRenderer(CyclesConfig())
    monkeypatch.setenv(process.VARIABLE, str(tmp_path))
    with pytest.raises(DopeError, match=r"\$DOPE_BPY_PYTHON is not an interpreter"):
        CyclesRenderer(CyclesConfig())


def test_an_interpreter_without_bpy_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bpy.py").write_text("raise ImportError('no bpy in here')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(DopeError, match=r"did not start: no bpy: no bpy in here.*pip install"):
        CyclesRenderer(HERE)
    (tmp_path / "bpy.py").write_text("import os\nos.write(2, b'libXi.so.6 is missing')\nos.abort()\n")
    with pytest.raises(DopeError, match=r"did not start: Blender was ended by SIGABRT.*libXi\.so\.6 is missing"):
        CyclesRenderer(HERE)


FAKE_BPY = """
import os, sys, time, types
print("Blender says hello on stdout")
os.write(1, b"and so does its C++\\n")
app = types.SimpleNamespace(version_string="0.1 module")
def reset(**_):
    print("Read new prefs", flush=True)
    {what}
ops = types.SimpleNamespace(wm=types.SimpleNamespace(read_factory_settings=reset))
"""


def fake_module(folder: Path, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bpy for the real worker, which does `what` when a scene is begun."""
    (folder / "bpy.py").write_text(FAKE_BPY.format(what=what))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(Path(__file__).parents[2])]))


def test_what_blender_prints_does_not_get_into_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_module(tmp_path, "raise ValueError('on purpose')", monkeypatch)
    rendering = CyclesRenderer(HERE)
    assert rendering.version.endswith("Blender 0.1 module")
    with pytest.raises(BadInput, match="could not render it: ValueError: on purpose"):
        next(rendering.render(small_scene(TINY)))
    rendering.close()


def test_memory_has_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_module(tmp_path, "bytearray(2 << 30)", monkeypatch)
    rendering = CyclesRenderer(HERE, Limits(memory_gib=1))
    with pytest.raises(BadInput, match="needed more than 1 GiB of memory"):
        next(rendering.render(small_scene(TINY)))
    rendering.close()


PARENT = """
import sys
from pipeline.render.config import CyclesConfig
from pipeline.render.cycles.renderer import CyclesRenderer
from pipeline.render.exposure import expose, show, white_under
from tests.pipeline.render_scenes import small_scene
rendering = CyclesRenderer(CyclesConfig(python=sys.executable))
print(rendering._process._process.pid, rendering._folder.path, flush=True)
{then}
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux's way to die with the parent")
@pytest.mark.parametrize("then", ["next(rendering.render(small_scene()))", "sys.stdin.read()"])
def test_the_parents_death_ends_the_child_busy_or_idle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, then: str
) -> None:
    fake_module(tmp_path, "time.sleep(60)", monkeypatch)
    command = [sys.executable, "-c", PARENT.format(then=then)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid, folder = parent.stdout.readline().split()
        time.sleep(0.3)
        assert Path(f"/proc/{pid}").exists()
        parent.kill()
    deadline = time.monotonic() + 10
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
            break  # dead; nobody has asked for its exit code yet
        time.sleep(0.05)
    else:
        assert not Path(f"/proc/{pid}").exists()
    PrivateFolder(Path(folder).parent).close()
    assert not Path(folder).exists()  # the next one swept it away


def test_folders_of_the_living_stay_and_those_of_the_dead_go(tmp_path: Path) -> None:
    mine = PrivateFolder(tmp_path)
    (tmp_path / "dope-cycles-abandoned").mkdir()
    (tmp_path / "dope-cycles-abandoned/lock").touch()
    (tmp_path / "other").mkdir()
    second = PrivateFolder(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {mine.path.name, second.path.name, "other"}
    mine.close()
    second.close()
    assert [path.name for path in tmp_path.iterdir()] == ["other"]


def test_exr_files_that_are_something_else_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, passes())
    read = read_exr(path)
    np.testing.assert_array_equal(read["ViewLayer.Combined.G"], passes()["ViewLayer.Combined.G"].astype(np.float32))
    whole = path.read_bytes()
    write_exr(path, passes(), compression=3)
    with pytest.raises(ValueError, match="compressed"):
        read_exr(path)
    write_exr(path, passes(), version=2 | 0x1000)
    with pytest.raises(ValueError, match="one part"):
        read_exr(path)
    for end in range(0, len(whole) - 1, 7):
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError):
            read_exr(path)


def test_blender_takes_no_more_memory_than_its_parent_may() -> None:
    """Only root may raise a limit: who asks for less than Blender's own gets that, and no error."""
    lines = [
        "import os, resource, sys",
        f"sys.path.insert(0, {str(process.WORKER.parent)!r})",
        "import worker",
        "resource.setrlimit(resource.RLIMIT_DATA, (2 << 30, 2 << 30))",
        "worker.limit_process(os.getppid(), 8 << 30)",
        "print(resource.getrlimit(resource.RLIMIT_DATA)[0] >> 30)",
    ]
    said = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=True)
    assert said.stdout == "2\n"
