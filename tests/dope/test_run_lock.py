import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tiny_runs import tiny
from tiny_shards import write_shards

from dope.common.errors import DopeError
from dope.run_lock import only_one
from dope.trainer import train

HOLD = "import sys, pathlib, os; from dope.run_lock import only_one\nwith only_one(pathlib.Path(sys.argv[1])):\n "
ROOT = str(Path(__file__).parents[2])


def holding(run: Path, then: str = "print(1, flush=True); sys.stdin.read()") -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD + then, str(run)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": ROOT},
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "1\n"
    return process


def test_a_second_training_into_a_run_is_refused_before_it_writes_anything(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    shards = write_shards(tmp_path / "shards", n_objects=4, pairs=1, size=32, n_points=60)
    with holding(tmp_path / "run") as first:
        with pytest.raises(DopeError, match=rf"run: another process trains into it \(process {first.pid} on .*--out"):
            train(shards, tmp_path / "run", tiny("validation.every=0"))
        assert [path.name for path in (tmp_path / "run").iterdir()] == [".lock"]
        first.kill()
    assert train(shards, tmp_path / "run", tiny("validation.every=0"))["status"] == "finished"


def test_what_a_killed_process_has_forked_does_not_hold_it(tmp_path: Path) -> None:
    """As the loader's workers, which see only after seconds that their parent is gone."""
    forks = "import time\n if os.fork(): print(1, flush=True); sys.stdin.read()\n else: time.sleep(20)"
    with holding(tmp_path, forks) as first:
        first.kill()
        first.wait()
        with only_one(tmp_path):
            pass
