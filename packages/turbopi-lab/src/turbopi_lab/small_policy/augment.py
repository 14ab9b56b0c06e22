"""Random changes of images, on the GPU, in the manner of openpi's training: crop and turn the base camera, and change
the colours of both. Smaller than openpi's: the cameras of this benchmark don't move.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

SHIFT = 6 / 112  # of half an image's width: 6 pixels of 224
TURN = math.radians(2.5)
ZOOM = 0.03
BRIGHTNESS, CONTRAST, SATURATION = 0.2, 0.2, 0.25


def augment(camera_images: Tensor) -> Tensor:
    """uint8[B, 2, 224, 224, 3], base camera first -> float32 in [-1, 1] of the same shape."""
    scaled = camera_images.float() / 127.5 - 1
    base = move(scaled[:, 0])
    both = torch.stack((base, scaled[:, 1]), dim=1)
    return recolor(both.flatten(0, 1)).view(both.shape)


def move(camera_images: Tensor) -> Tensor:
    """Shift, turn and zoom each image [B, H, W, 3] a little; what comes in from outside is the border's colour."""
    b, device = len(camera_images), camera_images.device

    def between(limit: float) -> Tensor:
        return (torch.rand(b, device=device) * 2 - 1) * limit

    angle, zoom = between(TURN), 1 + between(ZOOM)
    cos, sin = angle.cos() * zoom, angle.sin() * zoom
    matrix = torch.stack((cos, -sin, between(SHIFT), sin, cos, between(SHIFT)), dim=1).view(b, 2, 3)
    grid = F.affine_grid(matrix, [b, 3, *camera_images.shape[1:3]], align_corners=False)
    moved = F.grid_sample(camera_images.permute(0, 3, 1, 2), grid, padding_mode="border", align_corners=False)
    return moved.permute(0, 2, 3, 1)


def recolor(camera_images: Tensor) -> Tensor:
    """Brightness, contrast and saturation of each image [N, H, W, 3] in [-1, 1]."""
    n, device = len(camera_images), camera_images.device

    def factor(limit: float) -> Tensor:
        return 1 + (torch.rand(n, 1, 1, 1, device=device) * 2 - 1) * limit

    unit = (camera_images + 1) / 2 * factor(BRIGHTNESS)
    mean = unit.mean((1, 2, 3), keepdim=True)
    unit = (unit - mean) * factor(CONTRAST) + mean
    gray = unit.mean(3, keepdim=True)
    return ((unit - gray) * factor(SATURATION) + gray).clamp(0, 1) * 2 - 1
