"""The network's sizes, names, start and composition."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from dope.common.errors import BadInput
from dope.networks import STRIDE, DopeNetwork, MomentumEncoder, NetworkConfig
from dope.networks.resnet import ResNet18

SMALL = NetworkConfig(width=0.125, pyramid=16, projector=(32, 24))


def small_network(seed: int = 0, **changes: object) -> DopeNetwork:
    torch.manual_seed(seed)
    return DopeNetwork(NetworkConfig(**{**SMALL.__dict__, **changes}))


def count(*modules: nn.Module) -> int:
    return sum(p.numel() for module in modules for p in module.parameters())


def test_parameters_and_operations_are_the_papers() -> None:
    with torch.device("meta"):
        network = DopeNetwork(NetworkConfig())
        image = torch.zeros(1, 3, 224, 224)
        with FlopCounterMode(display=False) as encoder:
            network(image)
        with FlopCounterMode(display=False) as projector:
            network.project(torch.zeros(32, 128))
    resnet18 = 11_689_512 - 513_000  # torchvision's count less its classifier
    pyramid = 128 * (64 + 128 + 256 + 512 + 4) + 4 * (9 * 128 * 128 + 128)
    branches = 9 * (9 * 128 * 128 + 2 * 128)
    assert count(network.backbone) == resnet18
    assert count(network) - count(network.projector) == resnet18 + pyramid + branches + 128
    assert count(network.projector) == 128 * 1024 + 1024 + 2 * (1024 * 1024 + 1024) + 1024 * 256
    assert encoder.get_total_flops() / 1e9 == pytest.approx(8.55, abs=0.01)  # a multiply-add counts as two
    assert projector.get_total_flops() / 1e9 == pytest.approx(0.16, abs=0.01)


def test_backbone_keys_are_torchvisions() -> None:
    names = set(small_network().state_dict())
    blocks = [f"layer{stage}.{block}" for stage in (1, 2, 3, 4) for block in (0, 1)]
    norm = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    expected = {"conv1.weight", *(f"bn1.{n}" for n in norm)}
    expected |= {f"{block}.conv{i}.weight" for block in blocks for i in (1, 2)}
    expected |= {f"{block}.bn{i}.{n}" for block in blocks for i in (1, 2) for n in norm}
    expected |= {f"layer{s}.0.downsample.0.weight" for s in (2, 3, 4)}
    expected |= {f"layer{s}.0.downsample.1.{n}" for s in (2, 3, 4) for n in norm}
    assert {name.removeprefix("backbone.") for name in names if name.startswith("backbone.")} == expected


def test_backbone_shapes_stage_by_stage() -> None:
    with torch.device("meta"):
        network = ResNet18()
        stages = network(torch.zeros(2, 3, 224, 224))
        assert network.conv1.weight.shape == (64, 3, 7, 7)
        assert network.layer3[0].downsample[0].weight.shape == (256, 128, 1, 1)
    assert [tuple(x.shape[1:]) for x in stages] == [(64, 56, 56), (128, 28, 28), (256, 14, 14), (512, 7, 7)]


def test_output_shapes_follow_the_image() -> None:
    network = small_network().eval()
    output = network(torch.rand(2, 3, 96, 160))
    assert output.features.shape == (2, 16, 96 // STRIDE, 160 // STRIDE)
    assert output.mask_logits.shape == (2, 1, 96 // STRIDE, 160 // STRIDE)
    assert network.masks(torch.rand(1, 3, 32, 32)).shape == (1, 1, 8, 8)
    assert network.descriptors(torch.rand(1, 3, 32, 32)).shape == (1, 24, 8, 8)
    with pytest.raises(BadInput, match=r"200x224 px.*multiples of 32"):
        network(torch.rand(1, 3, 224, 200))


def test_pyramid_and_merge_equal_their_definition() -> None:
    network = small_network().eval()
    stages = network.backbone(torch.rand(1, 3, 64, 64))
    pyramid, up = network.pyramid, lambda x: x.repeat_interleave(2, 2).repeat_interleave(2, 3)
    inner = pyramid.lateral[3](stages[3])
    maps = [pyramid.output[3](inner)]
    for level in (2, 1, 0):
        inner = pyramid.lateral[level](stages[level]) + up(inner)
        maps.insert(0, pyramid.output[level](inner))
    total = torch.zeros_like(maps[0])
    for level, x in enumerate(maps):
        blocks = network.merge.branches[level].blocks
        assert len(blocks) == (3, 1, 2, 3)[level]
        for block in blocks:
            x = F.relu(block[1](block[0](x)))
            if level > 0:
                x = F.interpolate(x, size=(x.shape[2] * 2, x.shape[3] * 2), mode="bilinear", align_corners=False)
        total += x
    torch.testing.assert_close(network.merge(network.pyramid(stages)), total)


def test_initial_statistics() -> None:
    torch.manual_seed(0)
    network = DopeNetwork(NetworkConfig())
    parts = {"backbone.conv1": 7, "backbone.layer4.1.conv2": 3, "backbone.layer2.0.downsample.0": 1}
    parts |= {"pyramid.output.2": 3, "pyramid.lateral.3": 1, "merge.branches.3.blocks.1.0": 3}
    for name, k in parts.items():
        conv = network.get_submodule(name)
        assert isinstance(conv, nn.Conv2d) and conv.kernel_size == (k, k)
        expected = math.sqrt(2 / (k * k * conv.out_channels))
        assert conv.weight.std().item() == pytest.approx(expected, rel=0.03), name
        assert abs(conv.weight.mean().item()) < 0.05 * expected
    norms = [m for m in network.modules() if isinstance(m, nn.BatchNorm2d)]
    assert all((m.weight == 1).all() and (m.bias == 0).all() for m in norms)
    first, last = network.projector[0], network.projector[-1]
    assert isinstance(first, nn.Linear) and isinstance(last, nn.Linear) and last.bias is None
    assert first.weight.abs().max().item() == pytest.approx(1 / math.sqrt(128), rel=0.01)  # U(-b, b), b = fan_in^-1/2
    assert first.weight.std().item() == pytest.approx(1 / math.sqrt(3 * 128), rel=0.02)


def test_descriptors_are_masked_unit_projections() -> None:
    network = small_network().eval()
    images = torch.rand(2, 3, 64, 96)
    with torch.no_grad():
        output, dense = network(images), network.descriptors(images)
        for b, row, column in [(0, 0, 0), (1, 3, 17), (0, 15, 23)]:
            x = output.features[b, :, row, column]
            for layer in network.projector:
                x = layer(x)
            expected = x / x.norm() * torch.sigmoid(output.mask_logits[b, 0, row, column])
            torch.testing.assert_close(dense[b, :, row, column], expected)


def test_sampled_cells_equal_the_dense_map_there() -> None:
    network = small_network().eval()
    images = torch.rand(2, 3, 64, 96)
    cells = torch.stack([torch.randint(0, 16, (2, 7)), torch.randint(0, 24, (2, 7))], dim=-1)
    sampled, dense = network.sample(network(images), cells), network.descriptors(images)
    for b in range(2):
        for p, (row, column) in enumerate(cells[b].tolist()):
            torch.testing.assert_close(sampled[b, p], dense[b, :, row, column])


def test_contrastive_gradient_reaches_mask_head_and_backbone() -> None:
    network = small_network()
    cells = torch.randint(0, 8, (2, 5, 2))
    network.sample(network(torch.rand(2, 3, 32, 32)), cells).sum().backward()
    missing = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert missing == []


def test_without_mask_prediction_descriptors_are_unit_vectors() -> None:
    network = small_network(predict_mask=False)
    assert not any("mask" in name for name in network.state_dict())
    norms = network.descriptors(torch.rand(2, 3, 32, 32)).norm(dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms))
    assert (network.masks(torch.rand(2, 3, 32, 32)) == 1).all()


def test_bfloat16_autocast_gives_float32_unit_vectors() -> None:
    network = small_network(predict_mask=False)
    with torch.autocast("cpu", torch.bfloat16):
        output = network(torch.rand(2, 3, 32, 32))
        sampled = network.sample(output, torch.zeros(2, 4, 2, dtype=torch.long))
    assert output.features.dtype == torch.bfloat16 and sampled.dtype == torch.float32
    torch.testing.assert_close(sampled.norm(dim=-1), torch.ones(2, 4))


def test_load_backbone_takes_torchvision_weights_and_explains_others() -> None:
    torch.manual_seed(1)
    source, network = ResNet18(0.125), small_network()
    state = {**source.state_dict(), "fc.weight": torch.zeros(1000, 64), "fc.bias": torch.zeros(1000)}
    network.load_backbone({name: value for name, value in state.items() if "num_batches" not in name})
    images = torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(network.eval().backbone(images)[3], source.eval()(images)[3])
    with pytest.raises(BadInput, match=r"conv1\.weight has another shape.*width at 1\.0"):
        network.load_backbone(ResNet18(0.25).state_dict())
    with pytest.raises(BadInput, match=r"conv1\.weight is missing"):
        network.load_backbone({})
    with pytest.raises(BadInput, match=r"layer1\.2\.conv1\.weight is unknown"):
        network.load_backbone({**state, "layer1.2.conv1.weight": torch.zeros(1)})


def test_momentum_encoder_follows_parameters_and_keeps_its_own_statistics() -> None:
    network = small_network()
    encoder = MomentumEncoder(network, momentum=0.9)
    start = {name: p.clone() for name, p in network.named_parameters()}
    with torch.no_grad():
        for p in network.parameters():
            p.add_(torch.randn_like(p))
        network.backbone.bn1.running_mean.fill_(5.0)
    encoder.update(network)
    target = dict(network.named_parameters())
    for name, p in encoder.network.named_parameters():
        torch.testing.assert_close(p, 0.9 * start[name] + 0.1 * target[name])
        assert not p.requires_grad and target[name].requires_grad
    assert (encoder.network.backbone.bn1.running_mean == 0).all()
    output = encoder(torch.rand(2, 3, 32, 32))
    assert not output.features.requires_grad
    assert encoder.network.backbone.bn1.running_mean.any()  # training mode: it learns its own statistics
    assert not encoder.sample(output, torch.zeros(2, 1, 2, dtype=torch.long)).requires_grad
    other = MomentumEncoder(small_network(seed=1))
    other.load_state_dict(encoder.state_dict())
    for a, b in zip(other.state_dict().values(), encoder.state_dict().values(), strict=True):
        assert torch.equal(a, b)
