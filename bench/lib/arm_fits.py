"""The fits of a set of arms: to choose numbers of steps, and to score."""

from __future__ import annotations

import argparse
import os
from importlib.util import find_spec

import torch

from bench.lib.arms import ARMS, NETWORK, Arm, chosen_steps, steps_in
from bench.lib.one_fit import Fit, is_peer, plan
from bench.lib.scenes import Row
from warpgs.errors import UsageError

LEFT_OUT = 2
"""Number of training views that are left out at once if there are more than four; else each is left out in turn."""
LONG = 10_000
"""Number of steps above which the further seeds of a fit come after those of shorter fits."""


def work(fit: Fit) -> int:
    """Return roughly the time of a fit, in steps: a step of two models takes as long as four, one with more renders as two."""
    return steps_in(fit.preset) * (4 if "CorGS" in fit.preset else 2 if "rivals/" in fit.preset else 1)


def missing(arm: Arm) -> str:
    """Return what an arm needs that is not here; empty if nothing is missing."""
    if is_peer(arm.preset) and find_spec("gsplat") is None:
        return "gsplat is not installed"
    return f"{NETWORK} is not set" if f"${NETWORK}" in arm.preset and NETWORK not in os.environ else ""


class ArmFits:
    """The fits of a set of arms."""

    def __init__(self, a: argparse.Namespace, rows: dict[str, Row], folders: dict[str, str], device: torch.device):
        """Keep the arguments, the rows by name, and the folders of their scenes."""
        self.arms, self.seeds, self.folds = [arm for arm in ARMS[a.set][: a.arms] if not missing(arm)], a.seeds, a.folds
        self.rows, self.folders, self.device = rows, folders, str(device)

    def _plan(self, row: str, preset: str, seed: int, left_out: int) -> list[Fit]:
        place = (self.rows[row].split, self.rows[row].downscale)
        return plan(row, preset, seed, self.folders[row], place, left_out, self.device)

    def tuning(self) -> list[Fit]:
        """Return the fits that choose steps, the longest first."""
        found = []
        for name in self.rows:
            for preset in (arm.with_steps(n) for arm in self.arms for n in arm.steps):
                fits = self._plan(name, preset, 0, LEFT_OUT)
                found += [*fits[len(fits) // 2 :], *fits[: len(fits) // 2]][: self.folds]
        return sorted(found, key=work, reverse=True)

    def scored(self, done: list[dict], tuned: bool) -> list[Fit]:
        """Return the fits to all training views, seed by seed; if not ``tuned``, only first seeds of arms with fixed steps."""
        presets = [(name, self._preset(done, name, arm)) for arm in self.arms for name in self.rows if tuned or not arm.steps]
        fits = [
            fit
            for seed in range(self.seeds if tuned else min(1, self.seeds))
            for name, preset in presets if preset
            for fit in self._plan(name, preset, seed, 0)
        ]  # fmt: skip
        return sorted(fits, key=lambda fit: fit.seed > 0 and steps_in(fit.preset) > LONG)

    def _preset(self, done: list[dict], name: str, arm: Arm) -> str | None:
        if not arm.steps:
            return arm.preset
        try:
            return arm.with_steps(chosen_steps(done, name, arm))
        except UsageError as e:  # the tuning was cut short
            print(f"not fitted: {e}")
            return None
