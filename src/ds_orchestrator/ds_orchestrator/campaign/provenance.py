"""Records with a campaign what its results depend on besides its configuration: versions, and digests of files."""

from __future__ import annotations

from pathlib import Path

from ds_driver.control.autopilot import AUTOPILOT
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.drive_settings import DriveSettings
from ds_orchestrator.store.store import Store
from ds_sim.installation import versions

DRIVER_SHA256 = "sha256 of the driver's weights"
"""Name of the fact that holds the digest of the driver's files."""


def record_provenance(store: Store, settings: DriveSettings, folder: Path) -> None:
    """Record versions and digests; a campaign does not continue with another network or another car.

    Args:
        store: store of the campaign.
        settings: how its tests are driven.
        folder: its folder, for messages.

    Raises:
        ConfigError: the driver or a simulator has changed since the campaign began.
    """
    from ds_driver.networks.network_driver import driver_sha256
    from ds_sim.registry import make_simulator

    if settings.driver != AUTOPILOT:
        weights = driver_sha256(settings.driver)
        if store.note(DRIVER_SHA256, weights) != weights:
            raise ConfigError(
                f"the weights of {settings.driver} have changed since {folder} began: choose another --out"
            )
    for name, version in versions().items():
        if store.note(f"version {name}", version) != version:
            store.note(f"version {name}, later", version)
    known = store.notes()
    for name in settings.simulators:
        if "@" in name:
            key, content = f"car {name}", str(make_simulator(name).spec.extra.get("car", ""))
            if known.get(key, content) != content:
                raise ConfigError(
                    f"{name}: the file has changed since the campaign began: restore it, or choose another --out"
                )
            store.note(key, content)
