"""Augmentation of training samples on the fly, as the paper and its released code have it."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from pnu.geometry.transforms import rotate, rotation_matrix, small_rotation


class Augmentation:
    """Random changes of a sample whose clouds lie in the unit sphere; normals turn with their points.

    Input and target alike: rotation, scale, shift. The input alone, each with probability `input_probability`:
    Gaussian jitter of the points, and a small rotation. Each part has its own switch: a range of zero width or sigma 0
    (for the rotation, False).

    Args:
        rotation: turn input and target by a uniform random rotation
        scale: lowest and highest factor of input and target
        shift: greatest offset of input and target along each axis, of the unit sphere's radius
        jitter_sigma: standard deviation of each coordinate of the input's points
        jitter_clip: greatest offset by jitter
        tilt_sigma: standard deviation of the angles of the input's small rotation, in radians
        tilt_clip: greatest of those angles
        input_probability: of jitter, and of the small rotation
    """

    def __init__(
        self,
        rotation: bool = True,
        scale: tuple[float, float] = (0.9, 1.1),
        shift: float = 0.1,
        jitter_sigma: float = 0.025,
        jitter_clip: float = 0.05,
        tilt_sigma: float = 0.03,
        tilt_clip: float = 0.09,
        input_probability: float = 0.5,
    ) -> None:
        low, high = scale
        if not 0 < low <= high:
            raise ValueError(f"data.augmentation.scale: expected 0 < lowest <= highest, found {list(scale)}")
        for name, value in {"shift": shift, "jitter_sigma": jitter_sigma, "jitter_clip": jitter_clip,
                            "tilt_sigma": tilt_sigma, "tilt_clip": tilt_clip}.items():  # fmt: skip
            if value < 0:
                raise ValueError(f"data.augmentation.{name}: expected a number >= 0, found {value}")
        if not 0 <= input_probability <= 1:
            raise ValueError(f"data.augmentation.input_probability: expected 0 to 1, found {input_probability}")
        self.rotation, self.scale, self.shift = rotation, (float(low), float(high)), shift
        self.jitter_sigma, self.jitter_clip = jitter_sigma, jitter_clip
        self.tilt_sigma, self.tilt_clip = tilt_sigma, tilt_clip
        self.input_probability = input_probability

    def __call__(self, clouds: Mapping[str, Tensor], generator: torch.Generator) -> dict[str, Tensor]:
        """Clouds (B, n, 3 or 6) by name, "input" among them; all others are targets. The same keys, changed, each
        sample in its own way. The generator is of the clouds' device."""
        # every number is drawn whatever the switches are, so that one switch does not change the other parts
        samples, device = len(clouds["input"]), generator.device
        rotation = rotation_matrix(samples, generator=generator)
        low, high = self.scale
        factor = low + (high - low) * torch.rand(samples, 1, 1, generator=generator, device=device)
        offset = self.shift * (2 * torch.rand(samples, 1, 3, generator=generator, device=device) - 1)
        changed = {}
        for name, cloud in clouds.items():
            points, *normals = torch.split(cloud, 3, dim=-1)
            if self.rotation:
                points, *normals = (part @ rotation.transpose(-1, -2) for part in (points, *normals))
            changed[name] = torch.cat([points * factor + offset, *normals], -1)
        changed["input"] = self.disturb(changed["input"], generator)
        return changed

    def disturb(self, cloud: Tensor, generator: torch.Generator) -> Tensor:
        """Jitter and a small rotation about the origin, of the input alone."""
        samples, points, _ = cloud.shape
        drawn = torch.rand(samples, 2, 1, 1, generator=generator, device=generator.device) < self.input_probability
        jittered, tilted = drawn.unbind(1)
        noise = torch.randn(samples, points, 3, generator=generator, device=generator.device) * self.jitter_sigma
        tilt = small_rotation(samples, self.tilt_sigma, self.tilt_clip, generator=generator)
        if bool(jittered.any()):
            noise = noise.clamp(-self.jitter_clip, self.jitter_clip)
            cloud = torch.cat([cloud[..., :3] + torch.where(jittered, noise, 0.0), cloud[..., 3:]], -1)
        return torch.where(tilted, rotate(cloud, tilt), cloud) if bool(tilted.any()) else cloud


def from_options(options: Augmentation | Mapping[str, Any] | None) -> Augmentation | None:
    """The augmentation of a config group; None for none."""
    return Augmentation(**options) if isinstance(options, Mapping) else options
