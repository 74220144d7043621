"""What a recording suggests of the kind of its vision; the config's `vision: {kind: ...}`."""

from __future__ import annotations

import re

import numpy as np

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods.head.topics import VISION_ATTITUDE
from alidade.pipelines.methods.noise import typical
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.topics import wanted
from alidade.pipelines.settings import Config

# Cameras that look for tags deliver fewer attitudes a second.
_FAST_HZ = 80.0
# rad; so measured, motion capture at 25 Hz has 7e-5 to 5e-4 (six BROAD trials), with .5 deg of noise added 7e-3.
_TINY = 1e-3
_MOCAP = re.compile(r"mocap|vicon|optitrack|qualisys|motion_?capture", re.IGNORECASE)
# Fourth differences of white noise have so many times its variance: the binomial of 8 over 4.
_FOURTH = 70.0
# They are looked at so many at a time, three axes each, and noise is that of the quietest of these, but for a few.
_FEW, _QUIET = 25, 0.05


def proposed(recording: Recording, config: Config) -> tuple[str, ...]:
    """The kind that rate, covariance, noise, type or name suggest, with the reason; nothing where none does."""
    if "kind" in config.vision.model_fields_set:
        return ()
    name = config.topic(VISION_ATTITUDE)
    if not wanted(recording, config, VISION_ATTITUDE):
        return ("vision: {kind: pnp} (attitudes are measured in pictures of tags)",)
    try:
        poses = recording.poses(name)
    except InputError:
        return ()
    if _MOCAP.search(name):
        return (f"vision: {{kind: mocap}} (the name {name})",)
    if name in recording.topics and recording.topics[name].type == messages.ODOMETRY:
        return (f"vision: {{kind: vio}} ({name} is odometry)",)
    order = np.argsort(poses.t_ns, kind="stable")
    steps = np.diff(poses.t_ns[order])
    rate = 1e9 / float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    # Drivers that know nothing state next to nothing.
    noise = max(typical(poses.cov, 3, 4, 5) or 0.0, white_angle(poses.wxyz[order]))
    if rate < _FAST_HZ and noise >= _TINY:
        return ()
    return (f"vision: {{kind: mocap}} ({rate:.3g} attitudes/s on {name}, noise {np.rad2deg(noise):.2g} deg)",)


def white_angle(wxyz: Array) -> float:
    """Noise of attitudes (n, 4), rad per axis, where they turn least: fourth differences have motion in them, too."""
    turns = so3.log(so3.multiply(so3.inverse(wxyz[:-1]), wxyz[1:]))
    fourth = np.diff(turns, 3, axis=0)
    if len(fourth) < _FEW:
        return np.inf
    pieces = np.array_split(fourth, len(fourth) // _FEW)
    return float(np.quantile([robust_sigma(piece) for piece in pieces], _QUIET)) / _FOURTH**0.5
