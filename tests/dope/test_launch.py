"""`--nproc`: what becomes of ranks that are asked to stop, that err, and that die. Most run a script, not dope."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from dope import launch as launching
from dope.common.errors import BadInput, DopeError, UsageError, WorkerDied
from dope.launch import launch

ROOT = Path(__file__).parents[2]
HEAD = """
import os, pathlib, signal, sys, time
from dope.launch import as_rank
from dope.common.errors import BadInput, WorkerDied
rank, start, here = os.environ["RANK"], os.environ["TORCHELASTIC_RESTART_COUNT"], pathlib.Path(__file__).parent
(here / f"started-{rank}-{start}").write_text(str(os.getpid()))
"""


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("WORLD_SIZE", raising=False)


def run(folder: Path, script: str, max_restarts: int = 0) -> int:
    (folder / "rank.py").write_text(HEAD + script)
    return launch(2, max_restarts, [sys.executable, str(folder / "rank.py")])


def starts(folder: Path) -> int:
    return len(list(folder.glob("started-*")))


def signal_when(folder: Path, name: str, number: int) -> threading.Thread:
    def wait() -> None:
        while len(list(folder.glob(name))) < 2:
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


STOPS = """
def stop(*_):
    time.sleep(1)  # a long step, and its checkpoint
    (here / f"saved-{rank}").touch()
    sys.exit(75)

signal.signal(signal.SIGTERM, stop)
(here / f"ready-{rank}").touch()
time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP, signal.SIGINT])
def test_ranks_that_are_asked_to_stop_have_the_time_they_need(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(launching, "GRACE_S", 0.2)
    before = signal.getsignal(number)
    if before == signal.SIG_IGN:
        pytest.skip("these tests run under nohup, whose wish is heeded")
    signal_when(tmp_path, "ready-*", number)
    assert run(tmp_path, STOPS, max_restarts=1) == 75
    assert len(list(tmp_path.glob("saved-*"))) == 2 and starts(tmp_path) == 2
    assert signal.getsignal(number) == before


def test_an_error_is_that_of_the_launcher_and_starts_nothing_again(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"^here: what\. remedy$"):
        run(tmp_path, "with as_rank(): raise BadInput('what', where='here', remedy='remedy')", max_restarts=3)
    assert starts(tmp_path) <= 2 and not list(tmp_path.glob("started-*-1"))  # the other may end before it has begun


@pytest.mark.parametrize("dies", ["os.kill(os.getpid(), 9)", "os._exit(1)", "raise WorkerDied('a worker')"])
def test_a_death_starts_all_again(tmp_path: Path, capfd: pytest.CaptureFixture[str], dies: str) -> None:
    waits = "while not (here / 'started-0-0').exists(): time.sleep(0.01)"
    script = f"with as_rank():\n if start == '0':\n  {waits}\n  if rank == '1': {dies}\n  time.sleep(60)"
    assert run(tmp_path, script, max_restarts=1) == 0
    assert starts(tmp_path) == 4 and "starting all processes again (1 of 1)" in capfd.readouterr().err


def test_one_death_too_many_is_named(tmp_path: Path) -> None:
    with pytest.raises(DopeError, match=r"rank 0 was killed by SIGKILL.*--max-restarts"):
        run(tmp_path, "os.kill(os.getpid(), 9) if rank == '0' else time.sleep(60)", max_restarts=1)
    with pytest.raises(WorkerDied, match="a worker"):
        run(tmp_path, "with as_rank(): raise WorkerDied('a worker')", max_restarts=0)


def test_who_waits_for_a_dead_rank_is_killed_in_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launching, "GRACE_S", 0.5)
    deaf = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n(here / f'deaf-{rank}').touch()\ntime.sleep(60)"
    dies = "while not (here / 'deaf-1').exists(): time.sleep(0.05)\n os._exit(3)"
    with pytest.raises(DopeError, match="rank 0 ended with 3"):
        run(tmp_path, f"if rank == '0':\n {dies}\n{deaf}")


def test_ranks_of_other_launchers_start_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(UsageError, match=r"--nproc: .*WORLD_SIZE"):
        launch(2, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux")
def test_ranks_end_with_a_launcher_that_is_killed(tmp_path: Path) -> None:
    script = HEAD + "with as_rank():\n (here / f'ready-{rank}').touch()\n time.sleep(60)"
    (tmp_path / "rank.py").write_text(script)
    code = "import sys; from dope.launch import launch; launch(2, 0, [sys.executable, sys.argv[1]])"
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "rank.py")]) as launcher:
        while len(list(tmp_path.glob("ready-*"))) < 2:
            assert launcher.poll() is None
            time.sleep(0.05)
        launcher.kill()
    pids = [int(path.read_text()) for path in tmp_path.glob("started-*")]
    deadline = time.monotonic() + 10
    while any(map(alive, pids)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert len(pids) == 2 and not any(map(alive, pids))


def alive(pid: int) -> bool:
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_an_error_is_said_once_from_a_folder_with_a_cli_of_its_own(tmp_path: Path) -> None:
    """Wrong settings that only the ranks find; the user's own modules are not taken for ours."""
    from tiny_shards import write_shards

    shards = write_shards(tmp_path / "shards", n_objects=4, pairs=1, size=32, n_points=60)
    (tmp_path / "cli.py").write_text("raise SystemExit('the wrong one')")
    command = [sys.executable, str(ROOT / "cli.py"), "train", str(shards), "--out", "run", "--preset", "nano"]
    command += ["--nproc", "2", "--max-restarts", "1", "--set", "data.batch_size=3", "--set", "device=cpu"]
    answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert answer.returncode == 2, answer.stderr
    assert answer.stderr.count("cannot be divided") == 1 and "Traceback" not in answer.stderr
