"""Errors of cameras against those of another scene, after the similarity that aligns both."""

from __future__ import annotations

import numpy as np

from warpgs.pipeline.train.view_modules import similar_cameras
from warpgs.scene import Camera, View


def brought_over(of: dict[str, View], to: dict[str, View], train: list[str], names: list[str]) -> dict[str, Camera]:
    """Return the named cameras of one scene after the similarity that aligns its training cameras with those of another."""
    cameras, goal = {n: v.camera for n, v in of.items()}, [to[n].camera for n in train]
    return similar_cameras(cameras, [cameras[n] for n in train], goal, names)


def angles(of: dict[str, View], to: dict[str, View]) -> list[float]:
    """Return the angle between each camera's rotation and that in another scene, after the similarity [degrees]."""
    names = sorted(of.keys() & to.keys())
    cameras = brought_over(of, to, names, names)
    cosines = [(np.trace(to[n].camera.viewmat[:3, :3] @ cameras[n].viewmat[:3, :3].T) - 1) / 2 for n in names]
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))).tolist()


def errors(of: dict[str, View], to: dict[str, View]) -> dict[str, float]:
    """Return the errors of cameras against another scene after the similarity: degrees, and fractions of the mean distance."""
    names, off = sorted(of.keys() & to.keys()), angles(of, to)
    cameras = brought_over(of, to, names, names)
    centers = np.array([to[n].camera.center for n in names])
    spread = np.linalg.norm(centers - centers.mean(0), axis=1).mean()
    offsets = np.linalg.norm([cameras[n].center - to[n].camera.center for n in names], axis=1) / spread
    return {"degrees": float(np.median(off)), "degrees_max": max(off), "offset": float(np.median(offsets))}
