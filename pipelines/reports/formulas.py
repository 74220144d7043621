"""How each method's result is applied, for calibration.yaml and the report. Methods page, one section a method."""

from __future__ import annotations

# Method -> rotation-vector parameter -> the rotation it is.
ROTATIONS = {"head": {"helmet_mount": "vRh", "camera_mount": "cRb"}, "cube": {"camera_mount": "correction of BRC"}}

# Method -> formulas, in the names of the parameters.
FORMULAS: dict[str, tuple[str, ...]] = {
    "los": (
        "Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise; delta_z = delta_pz - delta_gz where those two are given",
        "M = Rz(delta_z) Rx(-delta_gx) Ry(-delta_gy) maps coordinates of the IMU to those of the carrier",
        "rate of the carrier, rad/s: w_b = M (gyro - gyro_bias)",
        "a direction of the carrier in the line-of-sight frame: d_l = Rx(elevation + delta_px) Rz(azimuth) d_b",
    ),
    "indexer": (
        "mRt = Rx(theta_x) Ry(theta_y) Rz(theta_z), Rx(a) = transpose(Exp(a ex)): t payload platform, m IMU on it",
        "rate of the payload platform, rad/s: w_it = inverse(mRt) (gyro - gyro_bias)",
        "carrier attitude: nRb = nRm mRt inverse(bRt), bRt = Exp(outer ex) Exp(inner ez) of the encoders' angles",
    ),
    "head": (
        "vRh = Exp(helmet_mount), cRb = Exp(camera_mount): v helmet IMU, h markers, c camera, b platform",
        "rate of the helmet, rad/s in v: w_iv = gyro - gyro_bias",
        "attitude of the helmet on the platform from a camera measurement cRh: bRv = inverse(cRb) * cRh * inverse(vRh)",
        "time of that attitude on the gyro's clock, s: stamp of the picture + time_offset",
    ),
    "cube": (
        "each triad (accel, gyro, mag): nominal = K raw + b, K = [[k11, k12, k13], [k21, k22, k23], [k31, k32, k33]]",
        "nominal is along the axes of the cube's body b, in m/s^2, rad/s and T; raw is as recorded",
        "camera mount: BRC = camera_rotation * Exp(camera_mount), camera_rotation as the config gives it",
        "tag on the cube: bodyRtag = rotation * Exp(tag_ID), rotation as the config gives it for that tag",
        "reference: nRB = Exp(reference_heading ez) * its attitude in East-North-Up",
        "attitude of the cube from a tag seen at CRT: nRb = nRB * BRC * CRT * inverse(bodyRtag)",
    ),
}
