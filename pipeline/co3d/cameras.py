"""CO3D's cameras in the one convention: from PyTorch3D's axes and NDC to OpenCV's axes and pixels.

PyTorch3D: x left, y up, z forward, row vectors, X_cam = X R + T. OpenCV: x right, y down, z forward, column vectors.
With F = diag(-1, -1, 1): R_cv = F R^T, t_cv = F T. In NDC the image's centre is 0 and its left and upper edges (not
the centres of the outermost pixels) are at +1, so that pixel centres come out at +0.5:

- ndc_norm_image_bounds: both edges at 1. f_px = f (W, H)/2, c_px = (1 - p) (W, H)/2;
- ndc_isotropic: the shorter side's edges at 1. f_px = f min(W, H)/2, c_px = (W, H)/2 - p min(W, H)/2.

Source: `PerspectiveCameras` and `_opencv_from_cameras_projection` of PyTorch3D, `load_co3d_cameras` of CO3D.
"""

from __future__ import annotations

import numpy as np

from pipeline.co3d.annotations import Viewpoint
from pipeline.geometry import Camera

FLIP = np.array([-1.0, -1.0, 1.0])
ROTATION_TOLERANCE = 1e-3


def to_opencv(viewpoint: Viewpoint, width: int, height: int) -> Camera:
    """The camera of an image of `width` x `height` pixels.

    Raises:
        ValueError: an intrinsics format that is not known, R is no rotation, or a focal length that is not positive.
    """
    half = np.array([width, height]) / 2
    if viewpoint.intrinsics_format.lower() == "ndc_norm_image_bounds":
        unit = half
    elif viewpoint.intrinsics_format.lower() == "ndc_isotropic":
        unit = np.full(2, half.min())
    else:
        raise ValueError(f"unknown intrinsics_format '{viewpoint.intrinsics_format}'")
    R = np.array(viewpoint.R).reshape(3, 3)
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError("viewpoint: R is not a rotation")
    focal = np.array(viewpoint.focal_length) * unit
    if (focal <= 0).any():
        raise ValueError("viewpoint: the focal length is not positive")
    cx, cy = half - np.array(viewpoint.principal_point) * unit
    K = np.array([[focal[0], 0, cx], [0, focal[1], cy], [0, 0, 1]])
    return Camera(width, height, K, np.zeros(4), FLIP[:, None] * R.T, FLIP * np.array(viewpoint.T))
