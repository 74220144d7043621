"""Parameters that each method's formulas are written with."""

from __future__ import annotations

from collections.abc import Collection

CUBE = (
    *(f"{s}_k{i}{j}" for s in ("accel", "gyro", "mag") for i in "123" for j in "123"),
    *(f"{s}_b{i}" for s in ("accel", "gyro", "mag") for i in "123"),
    *(f"{n}_{axis}" for n in ("camera_mount", "tag_17") for axis in "xyz"),
    "reference_heading",
)
CUBE_ERRORS = ("gyro_g_xx", "gyro_g_zy", "accel_square_2", "accel_cube_1", "accel_cube_3", "reference_tilt_n")
CASES: dict[str, tuple[str, Collection[str]]] = {
    "los": ("los", ("delta_px", "delta_gx", "delta_gy", "delta_z", "gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
    "los with options": (
        "los",
        (
            *("delta_px", "delta_gx", "delta_gy", "delta_pz", "delta_gz", "camera_roll", "collimation"),
            *("axis_nonperpendicularity", "gyro_bias_x", "gyro_bias_y", "gyro_bias_z", "time_offset"),
        ),
    ),
    "los of real sensors": (
        "los",
        (
            *("delta_px", "delta_gx", "delta_gy", "delta_z", "camera_roll", "collimation", "gyro_bias_x"),
            *("gyro_bias_y", "gyro_bias_z", "time_offset", "clock_skew", "los_scale", "encoder_delay"),
            *(f"encoder_{joint}_{part}" for joint in ("azimuth", "elevation") for part in ("sin", "cos")),
            *(f"gyro_scale_{axis}" for axis in "xyz"),
            *(f"gyro_skew_{axes}" for axes in ("xy", "xz", "yz")),
            *(f"gyro_g_{row}{column}" for row in "xyz" for column in "xyz"),
        ),
    ),
    "indexer": ("indexer", tuple(f"{name}_{axis}" for name in ("theta", "gyro_bias") for axis in "xyz")),
    "indexer with options": (
        "indexer",
        (
            *(f"{name}_{axis}" for name in ("theta", "gyro_bias", "gyro_scale") for axis in "xyz"),
            "axis_nonperpendicularity",
        ),
    ),
    "indexer of real sensors": (
        "indexer",
        (
            *(f"{name}_{axis}" for name in ("theta", "gyro_bias", "gyro_scale") for axis in "xyz"),
            *(f"gyro_skew_{axes}" for axes in ("xy", "xz", "yz")),
            *(f"encoder_{joint}_{part}" for joint in ("outer_x", "inner_z") for part in ("sin", "cos")),
            "encoder_delay",
        ),
    ),
    "head": (
        "head",
        (*(f"{n}_{axis}" for n in ("gyro_bias", "helmet_mount", "camera_mount") for axis in "xyz"), "time_offset"),
    ),
    "head of real sensors": (
        "head",
        (
            *(f"{n}_{axis}" for n in ("gyro_bias", "helmet_mount", "camera_mount", "gyro_scale") for axis in "xyz"),
            *(f"platform_{n}_{axis}" for n in ("bias", "scale") for axis in "xyz"),
            *("time_offset", "clock_skew", "gyro_skew_xz", "gyro_g_xy", "gyro_g_zz", "platform_skew_xy"),
        ),
    ),
    "cube": ("cube", CUBE),
    "cube of real sensors": ("cube", (*CUBE, *CUBE_ERRORS)),
    "cube in counts": ("cube", (*CUBE, *CUBE_ERRORS)),
}
