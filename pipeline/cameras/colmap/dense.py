"""Dense stereo with CUDA, and the fusion of what it finds."""

from __future__ import annotations

import ctypes
from pathlib import Path

from pipeline.cameras.colmap.base import ColmapError, explained, pycolmap


def has_cuda_gpu() -> bool:
    """True where dense stereo can run: pycolmap built with CUDA and a GPU that its driver can start."""
    if not pycolmap.has_cuda:
        return False
    try:  # the CUDA wheel says has_cuda without a GPU, and then aborts the process
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


def undistort(sparse: Path, images: Path, workspace: Path, *, max_image_size: int = -1, n_sources: int = 20) -> None:
    """Write COLMAP's dense workspace: undistorted images, their model, and each view's source views."""
    with explained("images could not be undistorted", images):
        pycolmap.undistort_images(
            workspace,
            sparse,
            images,
            num_patch_match_src_images=n_sources,
            undistort_options=pycolmap.UndistortCameraOptions(max_image_size=max_image_size),
        )


def patch_match(workspace: Path, *, gpu: int = 0, max_image_size: int = -1, geometric: bool = True) -> None:
    """CUDA PatchMatch stereo over a dense workspace; writes `stereo/depth_maps/*.geometric.bin` (or photometric)."""
    if not has_cuda_gpu():
        raise ColmapError(
            "PatchMatch stereo needs a CUDA GPU and the pycolmap-cuda12 wheel",
            where=workspace,
            remedy="Use the CPU's dense stereo instead",
        )
    options = pycolmap.PatchMatchOptions(gpu_index=str(gpu), max_image_size=max_image_size, geom_consistency=geometric)
    with explained("PatchMatch stereo failed", workspace):
        pycolmap.patch_match_stereo(workspace, options=options)


def fuse_depths(workspace: Path, ply: Path, *, threads: int = 1) -> int:
    """Points on which the geometric depth and normal maps of a workspace agree, as PLY; returns their number.

    Works without CUDA. Beside the PLY it writes `<name>.ply.vis`, which views see each point (for COLMAP's meshing).
    """
    options = pycolmap.StereoFusionOptions(num_threads=threads)
    with explained("depth maps could not be fused", workspace):
        return pycolmap.stereo_fusion(ply, workspace, options=options, output_type="PLY").num_points3D()
