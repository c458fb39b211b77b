"""`dope prep run` killed by SIGKILL at random moments, started again each time: are the shards the same, byte by byte?

    python -m benchmarks.kills --sequences 6 --kills 50 --seed 0 --out /tmp/kills

Films small objects, runs them undisturbed, then kills the whole process group again and again. Where a run comes to
its end before all kills are made, its shards are compared and it begins anew. Prints a JSON line a kill (where each
sequence was) and one at the end; exit code 1 where any byte differs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dope.common import files
from pipeline.demo.film import DemoConfig, FilmConfig, film_objects
from pipeline.run import STAGES

ROOT = Path(__file__).parents[1]
FILM = FilmConfig(width=320, height=240, frames=14, samples=1, detail=0.25, arc_deg=(100.0, 110.0))
FAMILIES = ("mug", "chair")


@dataclass(frozen=True)
class Run:
    """`dope prep run` of the films in `films` into `home`/work and `home`/shards."""

    films: Path
    home: Path
    workers: int = 2

    @property
    def work(self) -> Path:
        return self.home / "work"

    @property
    def shards(self) -> Path:
        return self.home / "shards"

    def start(self) -> subprocess.Popen[bytes]:
        """Start it, or go on with it, in a process group of its own; its output goes to `home`/log."""
        self.home.mkdir(parents=True, exist_ok=True)
        inputs = [str(self.films / family) for family in FAMILIES]
        words = [*inputs, "--masks", str(self.films / "masks"), "--out", str(self.work), "--shards", str(self.shards)]
        settings = ["--views-every", "1", "--workers", str(self.workers), "--set", "shards.samples_per_shard=32"]
        command = [sys.executable, "-m", "cli", "prep", "run", *words, *settings]
        with (self.home / "log").open("ab") as log:
            return subprocess.Popen(command, stdout=log, stderr=log, cwd=ROOT, start_new_session=True)

    def finish(self) -> None:
        """Run it to its end. Raises RuntimeError with the end of its log where it fails."""
        if self.start().wait():
            raise RuntimeError((self.home / "log").read_text(errors="replace")[-2000:])

    def kill_when(self, moment: Callable[[], bool]) -> bool:
        """Start it and kill it, and all its children, as soon as `moment()`; False where it ended before that."""
        process = self.start()
        while process.poll() is None:
            if moment():
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                return True
            time.sleep(0.002)
        return False

    def places(self) -> dict[str, str]:
        """Where it is: the stage that each begun sequence has still to finish, "shards" when all have been through."""
        folders = [path for path in self.work.iterdir() if path.is_dir()] if self.work.is_dir() else []
        todo = {}
        for folder in sorted(folders):
            done = {path.stem for path in (folder / "stages").glob("[!.]*.json")}
            todo[folder.name] = next((stage for stage in STAGES if stage not in done), "done")
        whole = bool(todo) and set(todo.values()) == {"done"}
        return {"all": "shards"} if whole else todo

    def bytes(self) -> dict[str, str]:
        """SHA-256 of every file of the shards."""
        return {path.name: files.sha256_of(path) for path in sorted(self.shards.iterdir())}


def film(out: Path, sequences: int) -> None:
    """Film the first `sequences` objects of both families in turn; the first of each has the same file name, 0.avi."""
    per_family = -(-sequences // len(FAMILIES))
    film_objects(out, DemoConfig(FAMILIES, (), per_family=per_family, containers=("avi",), film=FILM))
    for video in sorted(out.glob("*/*.avi"), key=lambda path: (path.stem.rpartition("_")[2], path.stem))[sequences:]:
        video.unlink()
    firsts = [out / family / f"{family}_0.avi" for family in FAMILIES]
    if all(video.is_file() for video in firsts):
        for video in firsts:  # whose id is that of its masks again: <family>_0
            video.replace(video.with_name("0.avi"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=6)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("kills"), help="scratch folder; work and shards are removed")
    options = parser.parse_args()
    options.out = options.out.absolute()
    draw = random.Random(options.seed)
    film(options.out / "films", options.sequences)
    undisturbed = Run(options.out / "films", options.out / "undisturbed", options.workers)
    start = time.monotonic()
    undisturbed.finish()
    seconds = time.monotonic() - start
    expected = undisturbed.bytes()

    kills, starts, rounds, different = 0, 0, 0, 0
    run = Run(options.out / "films", options.out / "killed", options.workers)
    while kills < options.kills:
        # up to a third of the whole: long enough that the work goes on, short enough that each stage is met
        moment = time.monotonic() + draw.uniform(0.0, seconds / 3)
        starts += 1
        if run.kill_when(lambda moment=moment: time.monotonic() >= moment):  # type: ignore[misc]
            kills += 1
            print(json.dumps({"kill": kills, "at": run.places()}), flush=True)
        else:
            rounds, different = rounds + 1, different + (run.bytes() != expected)
            shutil.rmtree(run.home)
    run.finish()
    rounds, different = rounds + 1, different + (run.bytes() != expected)
    facts = {
        "sequences": options.sequences,
        "kills": kills,
        "restarts": starts,
        "seconds_undisturbed": round(seconds, 1),
    }
    print(json.dumps({**facts, "files": len(expected), "finished_runs": rounds, "identical": not different}))
    for folder in (run.home, undisturbed.home):
        shutil.rmtree(folder, ignore_errors=True)
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
