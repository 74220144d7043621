"""What has to work wherever the distribution is installed; run outside the checkout, by `make dist`."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import alidade


def main() -> None:
    """Simulate a shipped scenario, calibrate it with the command, read the result, use the factors."""
    assert "site-packages" in str(alidade.__file__), alidade.__file__
    with tempfile.TemporaryDirectory() as folder:
        command = str(Path(sys.executable).with_name("alidade"))
        session, out = Path(folder) / "s.mcap", Path(folder) / "out"
        subprocess.run(
            [command, "simulate", "indexer", "--scenario", "indexer_ideal", "--out", str(session)], check=True
        )
        subprocess.run([command, "info", str(session)], check=True)
        subprocess.run([command, "calibrate", str(session), "--out", str(out)], check=True)
        assert (out / "report.html").stat().st_size > 100_000
        calibration = alidade.calibrate(session)
        assert calibration.status == "calibrated", calibration.headline
    from alidade import factors

    assert all(getattr(factors, name) is not None for name in factors.__all__)
    print("the installed distribution works")


if __name__ == "__main__":
    main()
