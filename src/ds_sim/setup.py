import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
from package_setup import setup_package

setup_package(scripts=["simulator = ds_base.executables:simulator"])
