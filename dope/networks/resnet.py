"""ResNet-18 as a four-stage feature extractor, with torchvision's parameter names (He et al., CVPR 2016)."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from dope.common.errors import BadInput

STAGES = (64, 128, 256, 512)  # channels at strides 4, 8, 16, 32


class BasicBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut: (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.relu = nn.ReLU(inplace=True)
        self.downsample: nn.Module | None = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        return self.relu(self.bn2(self.conv2(x)).add_(shortcut))


class ResNet18(nn.Module):
    """The convolutional part of ResNet-18; `channels` are those of its four stages, scaled by `width`."""

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        # multiples of 8 keep the convolutions on the fast paths of CPUs and tensor cores
        self.channels = tuple(max(8, round(channels * width / 8) * 8) for channels in STAGES)
        c1, c2, c3, c4 = self.channels
        self.conv1 = nn.Conv2d(3, c1, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(c1)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.layer1 = nn.Sequential(BasicBlock(c1, c1, 1), BasicBlock(c1, c1, 1))
        self.layer2 = nn.Sequential(BasicBlock(c1, c2, 2), BasicBlock(c2, c2, 1))
        self.layer3 = nn.Sequential(BasicBlock(c2, c3, 2), BasicBlock(c3, c3, 1))
        self.layer4 = nn.Sequential(BasicBlock(c3, c4, 2), BasicBlock(c4, c4, 1))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Map (B, 3, H, W) to the stages' features at strides 4, 8, 16 and 32."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(images))))
        x1 = self.layer1(x)
        x2 = self.layer2(x1)
        x3 = self.layer3(x2)
        return x1, x2, x3, self.layer4(x3)


def load_torchvision(network: ResNet18, state: Mapping[str, Tensor]) -> None:
    """Copy a torchvision resnet18 state dict into `network`; the classifier `fc` is left out.

    Raises:
        BadInput: keys are missing or unknown, or shapes differ.
    """
    own = network.state_dict()
    given = {name: value for name, value in state.items() if not name.startswith("fc.")}
    # state dicts older than PyTorch 0.4.1 have no batch counters
    missing = [name for name in own if name not in given and not name.endswith("num_batches_tracked")]
    unknown = [name for name in given if name not in own]
    differing = [name for name in given if name in own and given[name].shape != own[name].shape]
    for names, fault in ((missing, "is missing"), (unknown, "is unknown"), (differing, "has another shape")):
        if names:
            raise BadInput(
                f"not the weights of a ResNet-18 of this width: {names[0]} {fault} ({len(names)} such keys)",
                where="backbone weights",
                remedy="Give the state dict of torchvision.models.resnet18 and keep network.width at 1.0",
            )
    network.load_state_dict(own | given)
