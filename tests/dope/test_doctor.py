"""`dope doctor` on machines other than this one."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from dope import doctor


def found(what: str) -> doctor.Finding:
    return next(finding for finding in doctor.examine() if finding.what == what)


def test_a_missing_package_is_named_with_what_brings_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", (("opencv-python-headless", "no_such_module"),))
    finding = found("opencv-python-headless")
    assert finding.state == "missing" and finding.remedy == "pip install opencv-python-headless"
    assert doctor.show([finding], as_json=False) == 1
    assert "pip install opencv-python-headless" in " ".join(capsys.readouterr().out.split())


def test_a_module_that_another_package_brings_is_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", (("no-such-distribution", "json"),))
    finding = found("no-such-distribution")
    assert finding.state == "ok" and "'json'" in finding.detail


@pytest.mark.parametrize(
    ("script", "torch", "state", "detail"),
    [
        ("echo 'A GPU, 80 GiB'", "2.9.0+cu128", "ok", "A GPU, 80 GiB"),
        ("echo 'A GPU, 80 GiB'", "2.9.0+cpu", "unused", "torch 2.9.0+cpu cannot use it"),
        ("exit 9", "2.9.0", "optional", "everything works without one"),
    ],
)
def test_gpus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, torch: str, state: str, detail: str
) -> None:
    command = tmp_path / "nvidia-smi"
    command.write_text(f"#!/bin/sh\n{script}\n")
    command.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    finding = doctor._gpu(torch)
    assert finding.state == state and detail in finding.detail


def test_a_driver_that_hangs_is_no_crash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*_: object, **__: object) -> None:
        raise subprocess.TimeoutExpired("nvidia-smi", 20)

    monkeypatch.setattr(doctor.shutil, "which", lambda _: "nvidia-smi")
    monkeypatch.setattr(doctor.subprocess, "run", hang)
    assert doctor._gpu("2.9.0").state == "optional"


def test_every_package_that_is_required_is_looked_for() -> None:
    project = tomllib.loads((Path(doctor.__file__).parents[1] / "pyproject.toml").read_text())["project"]
    required = {re.split("[<>=]", text)[0] for text in project["dependencies"]} - {"pycolmap"}
    assert {distribution for distribution, _ in doctor.REQUIRED} == required
    remedies = " ".join(remedy for *_, remedy in doctor.OPTIONAL)
    extras = project["optional-dependencies"].keys() - {"dev"}
    assert all(f"[{extra}]" in remedies for extra in extras)


def test_a_machine_without_a_compiler_is_told_what_needs_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    finding = found("C++ compiler")
    assert finding.state == "optional" and "compile=true" in finding.detail and "g++" in finding.remedy
    (tmp_path / "clang++").touch(0o755)
    assert found("C++ compiler").state == "ok"
