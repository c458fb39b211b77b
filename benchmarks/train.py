"""The training service, measured: one JSON line a figure, ours beside the plain way (`benchmarks/plain.py`) in one run.

    python -m benchmarks.train                           # all figures that this machine can give; some minutes
    python -m benchmarks.train --only loss points        # machine loader loss points step gpu
    python -m benchmarks.train --shards SHARDS           # the loader on shards of your own

Each figure runs in a process of its own, on one thread; CPU seconds are user and system time, medians of several
rounds. `machine` says what this machine's matrix product and JPEG decoder give, so that figures of different machines
can be compared. `convolutions` in `step` is the time of the network's bare convolutions, below which no step can be.
Figures of a GPU are printed where there is one.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

FIGURES = ("machine", "loader", "loss", "points", "step", "gpu")


def say(figure: str, value: Any, **more: Any) -> None:
    print(json.dumps({"figure": figure, "value": value, **more}), flush=True)


def cpu_seconds() -> float:
    """User and system seconds of this process."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def median_cpu(work: Callable[[], Any], rounds: int) -> float:
    """Median CPU seconds of `work`, after one call to warm up."""
    work()
    taken = []
    for _ in range(rounds):
        start = cpu_seconds()
        work()
        taken.append(cpu_seconds() - start)
    return statistics.median(taken)


def peak_mib(*, anew: bool = False) -> float:
    """Peak resident memory of this process; `anew` begins a new peak, where Linux can do that."""
    status, refs = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not refs.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    kib = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM")).split()[1]
    if anew:
        refs.write_text("5")
    return int(kib) / 1024


def machine(_: argparse.Namespace) -> None:
    """What figures of other machines have to be divided by."""
    import torch

    a, b = torch.randn(2048, 2048), torch.randn(2048, 2048)
    say("matmul_gflops", round(2 * 2048**3 / median_cpu(lambda: a @ b, 7) / 1e9, 1))
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (224, 224, 3), dtype=np.uint8), (0, 0), 2)
    data = np.frombuffer(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes(), np.uint8)
    seconds = median_cpu(lambda: [cv2.imdecode(data, cv2.IMREAD_COLOR) for _ in range(500)], 5)
    say("jpeg_224px_a_cpu_second", round(500 / seconds))


def loader(given: argparse.Namespace) -> None:
    """Pairs a CPU second: decoding alone, and with the full augmentation in the same process."""
    import torch

    from dope.augmentation import WHOLE
    from dope.config import load_config
    from dope.heap import keep_heap
    from dope.step import sample_batch
    from dope.streaming import PairDataset, PairLoader

    keep_heap()
    with tempfile.TemporaryDirectory() as scratch:
        dataset = PairDataset(given.shards or made_shards(Path(scratch)), "train")
        size, rows = 16, np.arange(len(dataset))
        batches = [rows[i : i + size].tolist() for i in range(0, len(rows) - size + 1, size)]
        config, pairs = load_config("paper"), size * len(batches)

        def augmented() -> None:
            for step, batch in enumerate(PairLoader(dataset, batches)):
                sample_batch(batch, config, step, WHOLE)

        decoded = median_cpu(lambda: list(PairLoader(dataset, batches)), given.rounds)
        full = median_cpu(augmented, given.rounds)
    say("loader_decode_pairs_a_cpu_second", round(pairs / decoded), goal=800)
    say("loader_full_pairs_a_cpu_second", round(pairs / full), goal=300, released_code="28-33 on its machine")
    say("augmentation_cpu_ms_a_pair", round(1000 * (full - decoded) / pairs, 2), torch=torch.__version__)


def made_shards(folder: Path) -> Path:
    from tests.dope.tiny_shards import write_shards  # the shards of the tests, at the paper's size

    return write_shards(folder, n_objects=64, pairs=4, size=224, n_points=600, per_shard=64)


def loss(given: argparse.Namespace) -> None:
    """8,192 points of 256 pairs, 256-d: forward and backward."""
    rows = {name: in_child(_loss_of, name, given.rounds) for name in ("plain", "ours")}
    ours, plain = rows["ours"], rows["plain"]
    say("loss_cpu_seconds", ours["seconds"], goal=1.0, plain=plain["seconds"], times_less=ratio(plain, ours, "seconds"))
    say("loss_extra_mib", ours["mib"], goal=120, plain=plain["mib"], plain_tables_mib=plain["tables_mib"])
    say("loss_difference", abs(ours["loss"] - plain["loss"]), gradient=abs(ours["gradient"] - plain["gradient"]))


def _loss_of(name: str, rounds: int) -> dict[str, float]:
    import torch
    import torch.nn.functional as F

    from benchmarks.plain import TableLoss
    from dope.heap import keep_heap
    from dope.losses import contrastive_loss

    pairs, points = 256, 32
    generator = torch.Generator().manual_seed(0)
    queries = F.normalize(torch.randn(pairs * points, 256, generator=generator), dim=1).requires_grad_()
    keys = F.normalize(queries.detach() + 0.5 * torch.randn(pairs * points, 256, generator=generator), dim=1)
    number = torch.arange(pairs).repeat_interleave(points)
    (queries @ torch.randn(256, 64)).sum().backward()  # the libraries' own memory
    peak_mib(anew=True)
    before = peak_mib()
    if name == "plain":
        table = TableLoss(pairs, points)
    else:
        keep_heap()
    peak_mib(anew=True)
    start = peak_mib()

    def once() -> torch.Tensor:
        queries.grad = None
        if name == "plain":
            value = table(queries, keys)
        else:
            value = contrastive_loss(
                queries, keys, torch.arange(pairs * points), number, number, number, number, chunk=given_chunk()
            )
        value.backward()
        return value

    seconds = median_cpu(once, rounds)
    value = once()
    assert queries.grad is not None
    return {
        "seconds": round(seconds, 3),
        "mib": round(peak_mib() - start),
        "tables_mib": round(start - before),
        "loss": value.item(),
        "gradient": float(queries.grad.norm()),
    }


def given_chunk() -> int:
    from dope.config import LossConfig

    return LossConfig().chunk


def points(given: argparse.Namespace) -> None:
    """Farthest point sampling of 32 points: milliseconds a pair, in batches of 16 pairs."""
    import torch

    from benchmarks import plain
    from dope.farthest_points import farthest_points

    for n in (10_000, 512):  # 512: as many as the shards keep of a pair by default
        xy = torch.rand(16, n, 2, generator=torch.Generator().manual_seed(0)) * 224
        valid, start = torch.ones(16, n, dtype=torch.bool), torch.rand(16)
        ours = median_cpu(lambda xy=xy, v=valid, s=start: [farthest_points(xy, v, 32, s) for _ in range(20)], 5) / 320
        arrays = xy.numpy()
        slow = median_cpu(lambda arrays=arrays: [plain.farthest_points(array, 32) for array in arrays], 5) / 16
        say(
            f"farthest_32_of_{n}_ms", round(1000 * ours, 3), goal=0.6, plain=round(1000 * slow, 2),
            times_less=round(slow / ours, 1),
        )  # fmt: skip


def step(given: argparse.Namespace) -> None:
    """A training step of the paper's network on 16 pairs of 224 px, fp32, one thread: CPU seconds a pair."""
    rows = {name: in_child(_step_of, name, given.rounds) for name in ("plain", "ours")}
    floor = in_child(_convolutions, "paper", given.rounds)
    ours, plain = rows["ours"]["seconds"], rows["plain"]["seconds"]
    say(
        "step_cpu_seconds_a_pair", ours, plain=plain, share_of_plain=round(ours / plain, 3), goal_share=0.75,
        convolutions=floor["seconds"], released_code="0.63-0.77 on its machine",
    )  # fmt: skip
    say("step_peak_mib", rows["ours"]["mib"], plain=rows["plain"]["mib"])


PAIRS, POINTS = 16, 32


def _step_of(name: str, rounds: int) -> dict[str, float]:
    import torch

    from benchmarks.plain import PlainStep

    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(PAIRS, 3, 224, 224, generator=generator) for _ in range(2)]
    masks = torch.rand(PAIRS, 1, 224, 224, generator=generator) > 0.5
    xy = torch.rand(PAIRS, POINTS, 4, generator=generator) * 223
    if name == "plain":
        plain = PlainStep(PAIRS, POINTS)
        seconds = median_cpu(lambda: plain(images[0], images[1], masks.float(), xy), rounds)
    else:
        seconds = median_cpu(our_step(images, masks, xy), rounds)
    return {"seconds": round(seconds / PAIRS, 4), "mib": round(peak_mib())}


def our_step(images: list[Any], masks: Any, xy: Any) -> Callable[[], None]:
    """The step of `dope.trainer`, from an augmented batch to new weights."""
    import torch

    from dope.batch import PairBatch
    from dope.config import load_config
    from dope.distributed import Ranks
    from dope.heap import keep_heap
    from dope.methods import method_of
    from dope.state import new_state, wrap
    from dope.step import SampledBatch, compute_losses

    keep_heap()
    ranks, config = Ranks(0, 1, torch.device("cpu")), load_config("paper")
    method = method_of(config)
    state = new_state(method, ranks)
    online = wrap(method.online(state.network), ranks)
    cells, valid = (xy / 4).long(), torch.ones(PAIRS, POINTS, dtype=torch.bool)
    batch = PairBatch(images[0], images[1], masks, masks, xy, valid, torch.arange(PAIRS), ("",) * PAIRS)
    sampled = SampledBatch(batch, cells[..., [1, 0]], cells[..., [3, 2]], valid)

    def once() -> None:
        losses = compute_losses(online, state.momentum, sampled, config, ranks)
        state.optimiser.zero_grad(set_to_none=True)
        losses.backward()
        state.optimiser.step()
        state.momentum.update(state.network)

    return once


def _convolutions(_: str, rounds: int) -> dict[str, float]:
    """The bare convolutions of a step: forward and backward in the online encoder, forward in the momentum encoder."""
    import torch
    import torch.nn.functional as F

    from dope.heap import keep_heap
    from dope.networks import DopeNetwork, NetworkConfig

    keep_heap()
    network, shapes = DopeNetwork(NetworkConfig()), []
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):
            module.register_forward_hook(lambda m, args, _: shapes.append((m, args[0].shape)))
    with torch.no_grad():
        network(torch.rand(PAIRS, 3, 224, 224))

    def once() -> None:
        for number, (module, shape) in enumerate(shapes):
            x = torch.rand(shape, requires_grad=number > 0)  # the images need no gradient
            out = F.conv2d(x, module.weight, None, module.stride, module.padding)
            out.backward(torch.ones_like(out))
            with torch.no_grad():
                F.conv2d(x, module.weight, None, module.stride, module.padding)

    return {"seconds": round(median_cpu(once, rounds) / PAIRS, 4)}


def gpu(given: argparse.Namespace) -> None:
    """Pairs a second at batch 256 in bf16, the share of the time that the GPU waits, memory: where there is a GPU."""
    import torch

    if not torch.cuda.is_available():
        return
    from dope.config import load_config
    from dope.run_logging import read_metrics
    from dope.trainer import train

    with tempfile.TemporaryDirectory() as scratch:
        shards = given.shards or made_shards(Path(scratch) / "shards")
        settings = ["data.batch_size=256", "data.pairs_per_object=4", "schedule.max_steps=80", "validation.every=0",
                    "precision=bf16", "log_every=10"]  # fmt: skip
        train(shards, Path(scratch) / "run", load_config("fast", None, settings))
        rows = read_metrics(Path(scratch) / "run", "step")
        memory = read_metrics(Path(scratch) / "run", "memory")
    speed = statistics.median(row["pairs_per_second"] for row in rows[3:])
    a = torch.randn(8192, 8192, device="cuda", dtype=torch.bfloat16)
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(20):
        a @ a
    torch.cuda.synchronize()
    rate = 20 * 2 * 8192**3 / (time.perf_counter() - start)
    flops = 25.4e9 + 8.55e9 + 0.16e9 * 4  # a pair: encoder forward and backward, momentum encoder, projectors
    say("gpu_pairs_a_second", round(speed), device=torch.cuda.get_device_name(), batch=256)
    say("gpu_waits_for_data", statistics.median(row["data_wait"] for row in rows[3:]), goal=0.03)
    say("gpu_model_flop_utilisation", round(speed * flops / rate, 3), goal=0.4, matmul_tflops=round(rate / 1e12))
    say("gpu_memory_mib", memory[0]["peak_mib"], activations_mib=memory[0]["activations_mib"])


def ratio(plain: dict[str, float], ours: dict[str, float], key: str) -> float:
    return round(plain[key] / ours[key], 2)


def in_child(work: Callable[[str, int], dict[str, float]], name: str, rounds: int) -> dict[str, float]:
    """The result of `work(name, rounds)` in a fresh process, so that peak memory is its own."""
    with multiprocessing.get_context("spawn").Pool(1, initializer=one_thread) as pool:
        return pool.apply(work, (name, rounds))


def one_thread() -> None:
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES))
    parser.add_argument("--shards", type=Path, default=None, help="for the loader; default: made ones")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    one_thread()
    for name in given.only:
        globals()[name](given)


if __name__ == "__main__":
    main()
