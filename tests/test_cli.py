"""The command as a person meets it: fast help, clear errors, exit codes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import cli
from dope.preset_files import preset_names, preset_summary

ROOT = Path(__file__).parents[1]


def dope(*words: object, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120, **options)


@pytest.mark.parametrize(
    "words",
    [(), ("prep",), ("prep", "run"), ("prep", "colmap"), ("prep", "masks"), ("prep", "correspond"), ("prep", "shards"),
     ("prep", "status"), ("prep", "report"),
     ("train",), ("eval",), ("figure",), ("demo",), ("doctor",)],
)  # fmt: skip
def test_every_command_explains_itself(words: tuple[str, ...]) -> None:
    answer = dope(*words, "--help")
    assert answer.returncode == 0
    assert len(answer.stdout) > 200 and "Traceback" not in answer.stderr


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from typer.testing import CliRunner\n"
        "import cli\n"
        "assert CliRunner().invoke(cli.app, ['--help']).exit_code == 0\n"
        "print([m for m in ('torch', 'cv2', 'numpy', 'pycolmap', 'pyarrow', 'webdataset') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert answer.stdout.strip() == "[]"


def test_the_help_is_a_tour() -> None:
    text = dope("--help").stdout
    tour = ("prep run", "prep report", "train", "eval", "figure", "demo", "doctor")
    places = [text.index(f"dope {command}") for command in tour]
    assert places == sorted(places)


def test_doctor_lists_what_is_there() -> None:
    findings = {f["what"]: f for f in json.loads(dope("doctor", "--json").stdout)}
    assert findings["pycolmap"]["state"] == findings["torch"]["state"] == "ok"
    assert findings["torch"]["detail"].startswith("2.")
    assert {"CUDA GPU", "Blender (bpy)", "Ray"} <= set(findings)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shell_completion(shell: str) -> None:
    answer = dope("--show-completion", shell)
    assert answer.returncode == 0 and "complet" in answer.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("prep", "colmap", "a.mp4", "--out", "w", "--set", "sfm.max_image_sise=3"), "did you mean 'max_image_size'"),
        (("prep", "colmap", "a.mp4", "--out", "w", "--shard-index", "0"), "go together"),
        (("prep", "colmap", "a.mp4", "--out", "w", "--matching", "magic"), "not one of"),
        (("prep", "colmap", "a.mp4", "--out", "w", "--minutes", "0"), "must be positive"),
        (("prep", "colmap", "a.mp4", "--out", "w", "--category-from", "folder"), "not one of none, parent"),
        (("prep", "masks", "nowhere"), "nowhere"),
        (("train", "nowhere", "--out", "run", "--set", "data.batchsize=3"), "did you mean 'batch_size'"),
        (("train", "nowhere", "--out", "run", "--preset", "nanoo"), "did you mean 'nano'"),
    ],
)
def test_wrong_usage_is_explained(words: tuple[str, ...], message: str, tmp_path) -> None:
    answer = dope(*words)
    assert answer.returncode in (1, 2)
    assert message in " ".join(answer.stderr.split()) and "Traceback" not in answer.stderr
    assert not (ROOT / "w").exists() and not (ROOT / "run").exists()


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted; run the same command again to go on"),
        (PermissionError(13, "Permission denied", "/mine/work"), 1, "error: /mine/work: permission denied. Give a"),
        (FileExistsError(17, "File exists", "a_file"), 1, "error: a_file: file exists. Give a path"),
    ],
)
def test_what_stops_a_command_from_outside_is_explained(
    error: BaseException, code: int, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped() -> None:
        raise error

    monkeypatch.setattr("dope.doctor.examine", stopped)
    monkeypatch.setattr(sys, "argv", ["dope", "doctor"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == code and message in capsys.readouterr().err


def test_the_help_of_train_lists_every_preset_and_how_to_requeue() -> None:
    text = " ".join(dope("train", "--help", env={**os.environ, "COLUMNS": "200"}).stdout.replace("│", " ").split())
    for name in preset_names():
        assert f"{name}: {preset_summary(name)}" in text
    assert "#SBATCH --requeue and --signal=USR1@120" in text and "[ $? = 75 ] && scontrol requeue $SLURM_JOB_ID" in text
