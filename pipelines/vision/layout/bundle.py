"""Bundle adjustment of tags: poses of pictures, poses of tags on the body, and what is adjusted beside these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alidade.factors import so3
from alidade.pipelines.vision.layout.additional import Additional
from alidade.pipelines.vision.layout.normal import normal_equations, of_pictures
from alidade.pipelines.vision.layout.sights import Array, Bundle, Rows, Sights, linearized

_STEPS = 40
_DIAGONAL = np.arange(6)
# A step that changes the cost by less than this share ends the adjustment.
_SETTLED = 1e-10
# A picture whose step changes its cost by less than this share stays there.
_STEADY = 1e-6


def moved(bundle: Bundle, shared: Array, pictures: Array, additional: Additional) -> Bundle:
    """The bundle a step on: `shared` (p,) of tags and, if any, additional parameters, `pictures` (f, 6)."""
    tags = len(bundle.body.ids)
    step = shared[: 6 * tags].reshape(tags, 6)
    body = replace(
        bundle.body,
        bRt=so3.multiply(bundle.body.bRt, so3.exp(step[:, :3])),
        position=bundle.body.position + step[:, 3:],
    )
    there = replace(
        bundle,
        body=body,
        cRb=so3.multiply(bundle.cRb, so3.exp(pictures[:, :3])),
        position=bundle.position + pictures[:, 3:],
    )
    return additional.moved(there, shared[6 * tags :]) if len(shared) > 6 * tags else there


def adjusted(
    bundle: Bundle, sights: Sights, fixed: int, additional: Additional, far: float = np.inf, steps: int = _STEPS
) -> tuple[Bundle, Rows]:
    """The bundle of least squares, by Levenberg's and Marquardt's method.

    Args:
        bundle: where to start.
        sights: what is seen.
        fixed: index of the tag that stays.
        additional: what is adjusted beside poses.
        far: sum of squares of a tag in a picture beyond which it counts less and less (Geman, McClure).
        steps: at most.
    """
    rows, damping = linearized(bundle, sights), 1e-4
    cost = _cost(rows, bundle, additional, far)
    for _ in range(steps):
        normal = normal_equations(bundle, sights, rows, weights(rows, far), fixed, additional, damping)
        after = moved(bundle, *normal.step(), additional)
        there = linearized(after, sights)
        now = _cost(there, after, additional, far)
        if not now < cost:
            if damping > 1e6 or cost - now >= -_SETTLED * cost:
                break
            damping *= 10.0
            continue
        done = cost - now < _SETTLED * cost
        bundle, rows, cost, damping = after, there, now, 0.1 * damping
        if done:
            break
    return bundle, rows


def weights(rows: Rows, far: float) -> Array:
    """(m,) of Geman's and McClure's loss; 1 without bound."""
    return np.ones(len(rows.miss)) if np.isinf(far) else np.asarray((far / (far + rows.squares)) ** 2)


def loss(squares: Array, far: float) -> Array:
    """Geman's and McClure's of sums of squares."""
    return squares if np.isinf(far) else np.asarray(squares * (far / (far + squares)))


def _cost(rows: Rows, bundle: Bundle, additional: Additional, far: float) -> float:
    free = additional.free
    priors = (additional.off(bundle)[free] / additional.sigma[free]) ** 2
    return float(loss(rows.squares, far).sum() + priors.sum())


def refined_pictures(
    bundle: Bundle, sights: Sights, far: float = np.inf, steps: int = 15
) -> tuple[Bundle, Array, Array]:
    """Pictures one by one with the tags where they are; costs (f,) and information (f, 6, 6) of their poses too."""
    f = len(bundle.cRb)
    rows = linearized(bundle, sights)
    cost, damping = _costs(rows, sights, far, f), np.full(f, 1e-3)
    own, gradient, _ = of_pictures(sights, rows, weights(rows, far), f)
    going = own[:, 0, 0] > 0.0
    for _ in range(steps):
        seen = sights[going[sights.picture]]
        if not len(seen):
            break
        damped = own[going]
        damped[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping[going, None]
        step = np.zeros((f, 6))
        step[going] = -np.linalg.solve(damped, gradient[going, :, None])[..., 0]
        after = replace(
            bundle,
            cRb=so3.multiply(bundle.cRb, so3.exp(step[:, :3])),
            position=bundle.position + step[:, 3:],
        )
        there = linearized(after, seen)
        now = _costs(there, seen, far, f)
        better = going & (now < cost)
        bundle = replace(
            bundle,
            cRb=np.where(better[:, None], after.cRb, bundle.cRb),
            position=np.where(better[:, None], after.position, bundle.position),
        )
        new, slope, _ = of_pictures(seen, there, weights(there, far), f)
        own[better], gradient[better] = new[better], slope[better]
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        going &= np.abs(cost - now) > _STEADY * cost
        cost = np.where(better, now, cost)
    return bundle, cost, own


def _costs(rows: Rows, sights: Sights, far: float, f: int) -> Array:
    """(f,) of the pictures."""
    return np.asarray(np.bincount(sights.picture, loss(rows.squares, far), f), dtype=float)
