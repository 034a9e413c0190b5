"""Splits the bytes of a client into JSON objects, which follow one another with or without a separator."""

from __future__ import annotations

import json
from typing import Any

LARGEST_MESSAGE = 64 * 1024
"""Bytes of a message; chosen: gym-donkeycar's longest has some 300."""
_SPACE = b" \t\r\n\0"


class ProtocolError(ValueError):
    """A client sent what the protocol does not allow; its session ends."""


class MessageSplitter:
    """Collects bytes as they come, and finds the end of each object by its braces."""

    def __init__(self) -> None:
        self._pending = bytearray()
        self._looked_at = 0
        self._depth = 0
        self._in_text = False
        self._escaped = False

    def feed(self, data: bytes) -> list[dict[str, Any]]:
        """Take bytes.

        Returns:
            Messages that are now complete, each with a text `msg_type`.

        Raises:
            ProtocolError: the bytes are no JSON objects, or one is longer than `LARGEST_MESSAGE`.
        """
        self._pending += data
        messages = []
        while (end := self._end_of_object()) is not None:
            messages.append(_parse(bytes(self._pending[:end])))
            del self._pending[:end]
            self._looked_at = 0
        if len(self._pending) > LARGEST_MESSAGE:
            raise ProtocolError(f"a message has more than {LARGEST_MESSAGE} bytes: expected one short JSON object")
        return messages

    def _end_of_object(self) -> int | None:
        """Position after the first object, or None if it is not complete."""
        for position in range(self._looked_at, len(self._pending)):
            byte = self._pending[position]
            if self._depth == 0 and byte not in _SPACE and byte != ord("{"):
                raise ProtocolError(f"a message begins with {chr(byte)!r}: expected a JSON object")
            if self._in_text:
                self._in_text = self._escaped or byte != ord('"')
                self._escaped = byte == ord("\\") and not self._escaped
            elif byte == ord('"'):
                self._in_text = True
            elif byte == ord("{"):
                self._depth += 1
            elif byte == ord("}"):
                self._depth -= 1
                if self._depth == 0:
                    return position + 1
        self._looked_at = len(self._pending)
        return None


def _parse(text: bytes) -> dict[str, Any]:
    try:
        message = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"a message is not JSON ({error})") from None
    if not isinstance(message, dict) or not isinstance(message.get("msg_type"), str):
        raise ProtocolError("a message has no msg_type: expected such as control")
    return message
