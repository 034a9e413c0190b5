# SPDX-License-Identifier: Apache-2.0
"""Message types and message builder of bags, without ROS."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ds_base.bounded_file import read_words
from ds_base.errors import InputError
from ds_base.installation import share_folders
from ds_sim.messages import MessageBuilder

_OWN_MESSAGES = ("Outcome", "Road", "VehicleState", "DriveCommand")


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Message types of Jazzy and of `ds_interfaces`, the latter read from their installed definitions."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for share in share_folders("ds_interfaces"):
        folder = share / "msg"
        if (folder / "Road.msg").exists():
            types: dict[str, Any] = {}
            for name in _OWN_MESSAGES:
                types.update(get_types_from_msg(read_words(folder / f"{name}.msg"), f"ds_interfaces/msg/{name}"))
            store.register(types)
            return store
    raise InputError("ds_interfaces is not on AMENT_PREFIX_PATH: build the workspace and source its setup file")


def message_builder(namespace: str) -> MessageBuilder:
    """Make the builder of the messages of one simulator's bag, whose namespace prefixes its tf frames."""
    types = typestore().types
    return MessageBuilder(lambda name: types[name.replace("/", "/msg/")], np.asarray, namespace)
