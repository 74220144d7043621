"""Entry points: sessions, joint recordings, planning, validation, following, fleets, the command line and Python.

A `Session` (session.py) is a recording or arrays with a method and a config; it solves, tests and returns
`Calibration`s. `cli.py` and `api.py` are thin: options in, sessions asked, reports written. `joint.py` joins recordings
of one device by their square-root information, `follow/` calibrates while a recording grows, `fleet/` runs many in
processes.

The top room: imports all others, and none imports it.
"""

# Added by `apply` to the name of a topic for that of the corrected one.
CALIBRATED = "_calibrated"
