"""`dope doctor`: what is installed, what is missing, and which extra brings it."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

State = Literal["ok", "missing", "optional", "unused"]
STYLES = {
    "ok": "[green]ok[/]",
    "missing": "[red]missing[/]",
    "optional": "[yellow]not there[/]",
    "unused": "[yellow]unused[/]",
}


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's table."""

    what: str
    state: State
    detail: str
    remedy: str = ""


def examine() -> list[Finding]:
    """Look at this machine. Imports nothing heavy; asks a GPU through nvidia-smi."""
    findings = [Finding("python", "ok", sys.version.split()[0]), _machine()]
    findings += [_package(*entry) for entry in REQUIRED]
    findings += [_pycolmap(), _gpu(_version("torch") or "")]
    findings += [_compiler(), *(_optional(*entry) for entry in OPTIONAL)]
    return findings


REQUIRED = (
    ("torch", "torch"),
    ("opencv-python-headless", "cv2"),
    ("numpy", "numpy"),
    ("pyarrow", "pyarrow"),
    ("webdataset", "webdataset"),
    ("fsspec", "fsspec"),
    ("pyyaml", "yaml"),
    ("pycocotools", "pycocotools"),
    ("typer", "typer"),
    ("rich", "rich"),
    ("tensorboard", "tensorboard"),
    ("scikit-learn", "sklearn"),
)

OPTIONAL = (
    (
        "moderngl",
        "moderngl",
        "dope prep render, with libegl1 libgl1-mesa-dri",
        "pip install 'dope-descriptors[render]'",
    ),
    ("scipy", "scipy", "dope prep render", "pip install 'dope-descriptors[render]'"),
    (
        "Blender (bpy)",
        "bpy",
        "dope prep render --renderer cycles; may lie in an environment of its own",
        "python3.11 -m venv bpyenv && bpyenv/bin/pip install 'bpy==4.5.*' 'numpy<2'",
    ),
    ("OpenEXR", "OpenEXR", "depth maps in EXR files", "pip install 'dope-descriptors[exr]'"),
    ("Weights & Biases", "wandb", "--set log.wandb=PROJECT of dope train", "pip install 'dope-descriptors[wandb]'"),
    ("matplotlib", "matplotlib", "plots of `dope results`", "pip install 'dope-descriptors[plot]'"),
    ("s3fs", "s3fs", "shards in s3://", "pip install '.[s3]'"),
    ("gcsfs", "gcsfs", "shards in gs://", "pip install '.[gs]'"),
    ("huggingface_hub", "huggingface_hub", "shards in hf://", "pip install '.[hf]'"),
    ("Ray", "ray", "preparation on a cluster (planned)", "pip install '.[ray]'"),
)


def _package(distribution: str, module: str) -> Finding:
    if importlib.util.find_spec(module) is None:
        return Finding(distribution, "missing", "", f"pip install {distribution}")
    return Finding(distribution, "ok", _version(distribution) or f"'{module}' from a package of another name")


def _pycolmap() -> Finding:
    names = [name for name in ("pycolmap", "pycolmap-cuda12") if _version(name)]
    if len(names) == 2:
        detail = "pycolmap and pycolmap-cuda12 are both installed: they overwrite each other"
        return Finding("pycolmap", "missing", detail, "pip uninstall both, then install one of them")
    if not names:
        return Finding("pycolmap", "missing", "", "pip install pycolmap")
    kind = "CUDA: dense depth by PatchMatch" if names[0] == "pycolmap-cuda12" else "CPU: dense depth by stereo pairs"
    return Finding("pycolmap", "ok", f"{_version(names[0])} ({kind})")


def _gpu(torch_version: str) -> Finding:
    found = _nvidia_smi()
    if not found:
        return Finding("CUDA GPU", "optional", "everything works without one, training far slower")
    if "+cpu" in torch_version:
        remedy = "install the CUDA build of torch, see https://pytorch.org/get-started/locally"
        return Finding("CUDA GPU", "unused", f"{found}; but torch {torch_version} cannot use it", remedy)
    return Finding("CUDA GPU", "ok", found)


def _nvidia_smi() -> str:
    """The GPUs, or nothing where there is none or the driver does not answer."""
    command = shutil.which("nvidia-smi")
    if command is None:
        return ""
    query = [command, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, timeout=20, check=False)
    except (subprocess.TimeoutExpired, OSError):
        return ""
    return "; ".join(answer.stdout.strip().splitlines()) if answer.returncode == 0 else ""


def _compiler() -> Finding:
    """What torch.compile calls; PyTorch brings none."""
    purpose = "--set compile=true of dope train, which the preset fast has"
    found = next(filter(None, map(shutil.which, (os.environ.get("CXX", "g++"), "g++", "clang++"))), None)
    if found is None:
        return Finding("C++ compiler", "optional", purpose, "e.g. apt-get install g++")
    return Finding("C++ compiler", "ok", f"{found}: {purpose}")


def _optional(what: str, module: str, purpose: str, remedy: str) -> Finding:
    if importlib.util.find_spec(module) is not None:
        return Finding(what, "ok", f"{_version(module) or 'installed'}: {purpose}")
    return Finding(what, "optional", purpose, remedy)


def _machine() -> Finding:
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    return Finding("machine", "ok", f"{cpus} CPUs, {memory:.0f} GiB of memory, {free:.0f} GiB free in this folder")


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def show(findings: list[Finding], *, as_json: bool) -> int:
    """Print the findings; 1 where something required is missing, else 0."""
    if as_json:
        sys.stdout.write(json.dumps([asdict(finding) for finding in findings], indent=1) + "\n")
    else:
        table = Table(box=None, pad_edge=False, header_style="bold")
        for column in ("what", "state", "detail", "remedy"):
            table.add_column(column, overflow="fold")
        for finding in findings:
            table.add_row(finding.what, STYLES[finding.state], escape(finding.detail), escape(finding.remedy))
        Console(highlight=False).print(table)
    return 1 if any(finding.state == "missing" for finding in findings) else 0
