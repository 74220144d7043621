"""Results as files and pages: result.json, calibration.yaml, trajectories, HTML, certificate, exports.

`sentences.py` is the only place that puts findings in words. Nothing is solved here. Begin with `result.py`.
"""
