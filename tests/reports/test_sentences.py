"""Findings in words: one golden text of every kind, and headlines that keep all their reasons."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from alidade.pipelines.diagnostics.change_test import Stability
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.estimation.finding import KINDS, Finding, Severity, status
from alidade.pipelines.estimation.noise import Level, Noise
from alidade.pipelines.estimation.problem import ChiSquare, Estimate, Quantity, Residuals
from alidade.pipelines.reports.calibration_report import calibration_report, report_html
from alidade.pipelines.reports.result_json import finding_json, result_json
from alidade.pipelines.reports.sentences import cause, headline, notes, sentence, short_verdict
from tests.support.builders import make_calibration
from tests.support.pages import Page

NOTE, WEAK, INCONSISTENT, UNOBSERVABLE = Severity
MOUNT = Quantity("helmet_mount_z", "rad", 0.35, 0.35, 1e-2)
SCALE = Quantity("gyro_scale_x", "", 1e-2, 1e-2, np.inf, group="assumption", sheet="gyro.scale")
OFFSET = Quantity("time_offset", "s", 0.05, 0.05, 5e-3)
QUANTITIES = {q.name: q for q in (MOUNT, SCALE, OFFSET)}
CONFLICT = {"parameter": SCALE.name, "value": 0.06, "sigma": 1e-3, "z": 6.0}
REJECTED = Finding("rejection", INCONSISTENT, {"family": "vision", "share": 0.31, "noise_factor": 4.12})

GOLDEN: list[tuple[str, Severity, dict[str, Any], str]] = [
    ("not_converged", INCONSISTENT, {"message": "stuck"}, "No solution: stuck. Do not use the values."),
    (
        "direction",
        UNOBSERVABLE,
        {"weights": {"delta_px": 0.7, "delta_gx": -0.7}, "sigma_ratio": 0.981, "advice": "sway by 2 deg"},
        "Not observable: delta_px against delta_gx (sigma 0.98 of the prior). Sway by 2 deg.",
    ),
    (
        "direction",
        WEAK,
        {"weights": {"delta_px": 1.0}, "sigma_ratio": 0.2, "advice": "delta_px wants sway"},
        "Less accurate than required: delta_px (sigma 0.2 of the prior). delta_px wants sway.",
    ),
    (
        "hypothesis",
        INCONSISTENT,
        {"label": "x inverted", "chi_square_before": 9.1e4, "chi_square_after": 5512.0, "dof": 5397.0}
        | {"equivalents": ["y and z inverted"]},
        "Consistent with: x inverted (chi-square 91000 -> 5512, dof 5397). Equivalent: y and z inverted.",
    ),
    (
        "prior_conflict",
        INCONSISTENT,
        {**CONFLICT, "inseparable": ("gyro_scale_y",), "effect": {"helmet_mount_z": 7e-3}},
        "gyro_scale_x contradicts its data sheet (or gyro_scale_y, inseparable from it): 6.00 ± 0.10 %, prior 0 ± "
        "1.0 % (z = 6.0); its departure shifts helmet_mount_z by 0.40 deg, 0.7 of its requirement.",
    ),
    (
        "prior_conflict",
        NOTE,
        {"parameter": "helmet_mount_z", "value": 3.1, "sigma": 1e-3, "z": 8.9, "inseparable": (), "effect": {}},
        "helmet_mount_z is far from its prior: 177.617 ± 0.057 deg, prior 0 ± 20 deg (z = 8.9); check the orientation "
        "and the axis order of the sensor (`axes:` of its topic turns it, `[x, -y, -z]` by 180 deg about x), or widen "
        "the prior.",
    ),
    (
        "prior_conflict",
        NOTE,
        {"parameter": "time_offset", "value": -1.0257, "sigma": 1e-3, "z": -20.5, "inseparable": (), "effect": {}},
        "time_offset is far from its prior: -1025.7 ± 1.0 ms, prior 0 ± 50 ms (z = -20.5); check that both sensors are "
        "stamped by one clock, or widen the prior.",
    ),
    (
        "contradiction",
        INCONSISTENT,
        {"parameter": "camera_roll", "unit": "rad", "stated": 1e-12, "value": 0.05, "sigma": 1e-3, "z": 50.0}
        | {"inseparable": ("collimation",), "effect": {"helmet_mount_z": 7e-3}},
        "camera_roll is fixed at 0.000 deg by the config, and the recording contradicts it (or collimation): 2.865 ± "
        "0.057 deg if free (z = 50.0); freeing it shifts helmet_mount_z by 0.40 deg, 0.7 of its requirement.",
    ),
    (
        "change",
        INCONSISTENT,
        {"since_s": 42.1, "time_s": 42.2, "steps": {"helmet_mount_z": (8.9e-3, 7e-4)}},
        "Change at 42 s: helmet_mount_z by 0.510 ± 0.040 deg.",
    ),
    (
        "change",
        INCONSISTENT,
        {"since_s": 42.1, "time_s": 42.2, "steps": {}},
        "Change at 42 s: the parts before and after it fit by themselves, not together.",
    ),
    (
        "change",
        NOTE,
        {"since_s": 38.2, "time_s": 42.2, "steps": {}},
        "Change between 38 and 42 s. Immaterial; included in the sigmas.",
    ),
    (
        "jump",
        Severity.WEAK,
        {"since_s": 117.5, "time_s": 117.6, "size": 0.0105, "sigma": 0.0018},
        "Vision jumped by 0.60 ± 0.10 deg at 118 s; the motion does not show whether the mount or the reference.",
    ),
    (
        "device_change",
        INCONSISTENT,
        {"parameter": "helmet_mount_z", "step": 8.9e-3, "sigma": 7e-4, "recordings": ("a.mcap", "b.mcap")}
        | {"dates": ("2026-03-02T10:00:00+00:00", "2026-06-03T10:00:00+00:00")},
        "Change of the device between 2 March 2026 and 3 June 2026: helmet_mount_z by 0.510 ± 0.040 deg.",
    ),
    (
        "rejection",
        INCONSISTENT,
        REJECTED.evidence,  # type: ignore[list-item]
        "31 % of vision measurements rejected; all would fit 4.1 times the noise.",
    ),
    (
        "disturbance",
        NOTE,
        {"family": "magnetometer", "since_s": 12.31, "time_s": 15.8, "rejected": 71},
        "magnetometer disturbed 12.3 to 15.8 s: 71 measurements are left out there.",
    ),
    (
        "disturbance",
        WEAK,
        {"family": "magnetometer", "since_s": 12.31, "time_s": 15.8, "rejected": 71},
        "magnetometer disturbed 12.3 to 15.8 s: 71 measurements are left out there, and nothing shows that the "
        "calibration holds afterwards.",
    ),
    (
        "noise",
        INCONSISTENT,
        {"noise": "vision_attitude", "unit": "rad", "source": "config", "used": 0.078}
        | {"factor": 9.0, "estimated_factor": 9.02},
        "Noise vision_attitude: estimated 9 times the config's value; not white noise: check that gyro and vision are "
        "of one device and time, and the meaning of the quaternions.",
    ),
    (
        "noise",
        INCONSISTENT,
        {"noise": "corner_px", "unit": "px", "source": "default", "used": 6.9}
        | {"factor": 23.0, "estimated_factor": None},
        "Noise corner_px: estimated 23 times the default's value; not white noise: check camera_info (lens, size and "
        "rectification of the pictures) and the layout of the tags.",
    ),
    (
        "noise",
        NOTE,
        {"noise": "vision_attitude", "unit": "rad", "source": "config", "used": 0.0087}
        | {"factor": 3.0, "estimated_factor": 3.0},
        "Noise vision_attitude: 0.498 deg used, 3 times the config's value.",
    ),
    (
        "correlation",
        INCONSISTENT,
        {"family": "vision", "share": 0.24},
        "Residuals of vision are correlated over 24 % of the recording.",
    ),
    (
        "error_map",
        NOTE,
        {
            "name": "vision_map",
            "unit": "rad",
            "rms": 1.75e-3,
            "prior": 1.75e-3,
            "chi_square": 48.0,
            "dof": 23,
            "effect": {},
        },
        "vision_map: errors depend on the attitude, 0.10 deg rms, data sheet 0.10 (chi-square 48.0, dof 23). Sigmas "
        "include their uncertainty.",
    ),
    (
        "correlated_error",
        NOTE,
        {"noise": "vision_correlated", "unit": "rad", "used": 8.7e-3, "correlation_time": 0.34},
        "vision_correlated: errors are correlated in time, 0.50 deg, correlation time 0.34 s. Sigmas include them.",
    ),
    (
        "slow_error",
        NOTE,
        {"parameter": "helmet_mount_z", "ratio": 2.46},
        "Warning: errors of a sensor vary slowly, for example with the pose, unlike noise: from blocks of 5 s the "
        "sigma of helmet_mount_z is 2.5 times the nominal one. Sigmas include it.",
    ),
    (
        "misfit",
        INCONSISTENT,
        {"family": None, "chi_square": 71571.0, "dof": 5397.0, "largest": "vision", "noise_factor": 3.64},
        "Residuals exceed the noise used: chi-square 71570, 99.9 % bound 5745 (dof 5397); largest for vision, 3.6 "
        "times its noise.",
    ),
    (
        "misfit",
        NOTE,
        {"family": None, "chi_square": 1040.0, "dof": 2000.0, "largest": "vision", "noise_factor": 0.2},
        "Residuals are smaller than the noise used: chi-square 1040, 99.9 % bound 1798 (dof 2000); smallest for "
        "vision, 0.2 times its noise.",
    ),
    (
        "dominant_prior",
        WEAK,
        {"figure": "gyro.scale", "stated": 0.01, "share": 0.83},
        "83 % of that variance comes from gyro scale: state sensors.gyro.scale (now 0.01) if it is better.",
    ),
    (
        "ambiguous_solution",
        NOTE,
        {"chi_square": 2.31, "values": {"helmet_mount_z": (0.1, 0.5)}},
        "A second solution is nearly as likely (chi-square with priors is higher by 2.3): helmet_mount_z 5.73 instead "
        "of 28.6 deg; whole in second_best of result.json.",
    ),
    (
        "solver_difference",
        NOTE,
        {"parameter": "helmet_mount_z", "z": -1.52, "sigma_ratio": 0.9},
        "The run's own last estimate differed by up to 1.5 sigma (helmet_mount_z).",
    ),
    (
        "recording",
        INCONSISTENT,
        {"recording": "a.mcap", "findings": (REJECTED,)},
        "a.mcap by itself: 31 % of vision measurements rejected; all would fit 4.1 times the noise.",
    ),
    (
        "recordings_disagree",
        INCONSISTENT,
        {"recordings": ("a.mcap", "b.mcap"), "dates": (), "chi_square": 99.0, "dof": 3},
        "The recordings disagree about the device: chi-square 99 (dof 3).",
    ),
    ("remark", NOTE, {"text": "No platform IMU."}, "No platform IMU."),
    (
        "hypothesis",
        INCONSISTENT,
        {"label": "x inverted", "chi_square_before": None, "chi_square_after": 5512.0, "dof": 5397.0}
        | {"equivalents": []},
        "Consistent with: x inverted (no usable solution as recorded, corrected chi-square 5512, dof 5397).",
    ),
]


@pytest.mark.parametrize(("kind", "severity", "evidence", "text"), GOLDEN, ids=[f"{g[0]}-{g[1].name}" for g in GOLDEN])
def test_sentence_of_every_kind(kind: str, severity: Severity, evidence: dict[str, Any], text: str) -> None:
    finding = Finding(kind, severity, evidence)
    assert sentence(finding, QUANTITIES) == text
    json.dumps(finding_json(finding), allow_nan=False)


def test_every_kind_has_a_golden_sentence() -> None:
    assert {golden[0] for golden in GOLDEN} == set(KINDS)


def test_evidence_of_another_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="evidence of correlation: family, share"):
        Finding("correlation", NOTE, {"family": "vision"})


def inconsistent(sigma: float) -> tuple[Estimate, list[Quantity]]:
    """A conflict that matters, noise far above its statement, a rejected third and correlated residuals."""
    quantities = [Quantity("helmet_mount_z", "rad", 0.35, 0.35, 1e-4), SCALE]
    covariance = np.array([[sigma**2, 0.5 * sigma * 1e-3], [0.5 * sigma * 1e-3, 1e-6]])
    used = np.arange(300) % 3 > 0
    level = Level(Noise("vision_attitude", 1e-3, "config", 0.1, ("vision",)), 9.0, 9.0, 0.1)
    estimate = Estimate(
        "batch",
        ("helmet_mount_z", "gyro_scale_x"),
        np.array([0.0, 0.06]),
        covariance,
        True,
        "",
        residuals={"vision": Residuals(np.arange(300.0), np.ones((300, 3)), used)},
        chi_square=ChiSquare(900.0, 900.0, {"vision": (900.0, 900.0)}),
        levels=(level,),
        colours={"vision": 72.0},
    )
    return estimate, quantities


def test_a_headline_keeps_all_its_reasons() -> None:
    """With a cause the others once stood nowhere in words."""
    estimate, quantities = inconsistent(1e-5)
    hypothesis = Finding(*GOLDEN[3][:3])
    findings = diagnose(estimate, quantities, None, None, [hypothesis])
    assert status(findings) == "inconsistent"
    text = headline(findings, {q.name: q for q in quantities}, {})
    reasons = [
        "Consistent with: x inverted",
        "gyro_scale_x contradicts its data sheet",
        "33 % of vision measurements rejected",
        "Noise vision_attitude: estimated 9 times",
        "Residuals of vision are correlated over 24 %",
    ]
    places = [text.index(reason) for reason in reasons]
    assert places == sorted(places)


def test_what_is_not_observable_comes_before_a_prior_conflict() -> None:
    """The headline once said of an unobservable result only that a scale is not what was assumed."""
    estimate, quantities = inconsistent(0.35)
    findings = diagnose(estimate, quantities)
    assert status(findings) == "unobservable"
    text = headline(findings, {q.name: q for q in quantities}, {})
    assert text.startswith("Not observable: helmet_mount_z ")
    assert "gyro_scale_x contradicts its data sheet" in text


def test_many_of_a_kind_are_counted() -> None:
    found = [replace(REJECTED, evidence={**REJECTED.evidence, "family": f"f{i}"}, severity=NOTE) for i in range(5)]
    assert len(notes(found, QUANTITIES)) == 4
    assert notes(found, QUANTITIES)[-1] == "2 more of this kind in result.json"


def test_causes_are_those_that_explain() -> None:
    conflict = Finding("prior_conflict", INCONSISTENT, GOLDEN[4][2])
    found = cause(conflict, QUANTITIES)
    assert found is not None
    assert found[0] == "gyro_scale_x contradicts its data sheet (or gyro_scale_y, inseparable from it)"
    assert cause(replace(conflict, severity=NOTE), QUANTITIES) is None
    assert cause(REJECTED, QUANTITIES) is None


def test_result_json_has_findings_and_tables() -> None:
    calibration = replace(make_calibration(), findings=(REJECTED,), tables={"static_poses": [{"pose": 1}]})
    content = json.loads(result_json(calibration))
    assert content["findings"] == [
        {"kind": "rejection", "severity": "inconsistent", "family": "vision", "share": 0.31, "noise_factor": 4.12}
    ]
    assert content["tables"] == {"static_poses": [{"pose": 1}]}
    assert content["status"] == "inconsistent"
    page = Page(report_html(calibration)).text
    assert page.count("31 % of vision measurements rejected") == 2  # in the verdict, and in all findings


JUMP = Finding("jump", WEAK, {"since_s": 117.5, "time_s": 117.6, "size": 0.0105, "sigma": 0.0018})


def test_the_short_verdict_gives_the_finding_that_makes_the_status() -> None:
    """A jump with all accuracies met read "weak. 0 of 7 parameters miss their required accuracy"."""
    text, action = short_verdict([JUMP], QUANTITIES, {MOUNT.name: "observable"}, "")
    assert text == sentence(JUMP, QUANTITIES)
    assert action.startswith("What to do: ")
    both, _ = short_verdict([JUMP], QUANTITIES, {MOUNT.name: "weak"}, "")
    assert both == f"{text} 1 of 1 parameters miss their required accuracy."


def test_nothing_is_stable_where_a_jump_is_found() -> None:
    quiet = replace(make_calibration(), stability=Stability(0.1, 0.9, 5.0, {}))
    page = calibration_report(quiet).summary, calibration_report(replace(quiet, findings=(JUMP,))).summary
    said = [[badge.text for badge in each.badges] for each in page if each is not None]
    assert "stable" in said[0]
    assert "vision jumped" in said[1]
    assert "stable" not in said[1]


def test_badges_say_what_they_compare() -> None:
    """A noise that nobody stated read "× stated", and "misfit" alone what nobody knew."""
    level = Level(Noise("gyro_density", 1e-4, "default", 1.0, ("gyro",)), 3.0)
    poor = ChiSquare(2352.0, 588.0, {"vision": (2352.0, 588.0)})
    summary = calibration_report(make_calibration(chi_square=poor, levels=(level,))).summary
    assert summary is not None
    said = [badge.text for badge in summary.badges]
    assert "misfit: residuals 2 × the noise" in said
    assert "gyro_density 3.0 × the default" in said


def test_without_a_solution_nothing_is_said_to_be_good() -> None:
    """Tables with ✓, "fit as expected" and gains once stood under "No solution"."""
    made = make_calibration(converged=False, message="not converged after 63 iterations")
    text = str(replace(made, stability=Stability(0.1, 0.9, 5.0, {})))
    assert text.startswith("inconsistent. No solution: not converged after 63 iterations. Do not use the values.")
    assert set(made.verdicts.values()) == {"unobservable", "fixed"}
    assert not any(word in text for word in ("✓", "as expected", "stable", "times less"))
    assert made.uses == ()


def test_a_recording_that_determines_next_to_nothing_is_said_to_be_too_short() -> None:
    made = make_calibration()
    wide = np.diag([0.35**2] * 3 + [0.05**2, 0.05**2, 0.0])
    short = replace(made.estimate, converged=False, message="not converged after 63 iterations", covariance=wide)
    (finding,) = diagnose(short, made.problem.quantities)[:1]
    assert finding.evidence["message"] == (
        "the recording is too short, or has too little motion, for 5 of 5 parameters "
        "(not converged after 63 iterations)"
    )
    contradictory = replace(short, chi_square=ChiSquare(1e6, 1000.0, {}))
    (finding,) = diagnose(contradictory, made.problem.quantities)[:1]
    assert finding.evidence["message"] == "not converged after 63 iterations"


def test_residuals_far_beyond_the_noise_are_not_said_to_be_of_too_little_motion() -> None:
    made = make_calibration()
    wide, poor = np.diag([0.35**2] * 3 + [0.05**2, 0.05**2, 0.0]), ChiSquare(1e6, 588.0, {"vision": (1e6, 588.0)})
    message = "not converged after 63 iterations"
    bad = replace(made.estimate, converged=False, message=message, covariance=wide, chi_square=poor)
    (finding,) = diagnose(bad, made.problem.quantities)[:1]
    assert finding.evidence["message"] == message


def test_a_cause_that_is_but_noted_adds_no_stray_full_stop() -> None:
    note = Finding("prior_conflict", NOTE, {**CONFLICT, "inseparable": (), "effect": {}})
    _, action = short_verdict([REJECTED, note], QUANTITIES, {MOUNT.name: "observable"}, "")
    assert action == "Do not use the values before the cause is found."
