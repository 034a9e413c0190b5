#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Set the project up: once, from a bare machine to a built workspace. A second call finds nothing to do.

Usage: python3 tools/setup.py [--dev] [--docs] [--begin]

    --dev    also install what the tests need
    --docs   also install what builds the documentation
    --begin  return when the libraries are there, with which all runs that needs no ROS; go on in the background
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path


def main() -> int:
    """Run set-up; the result is the exit status."""
    if sys.version_info < (3, 9):  # noqa: UP036 - whatever Python the system has
        print("set-up needs Python 3.11 or 3.12: apt-get install -y python3 python3-dev python3-venv", file=sys.stderr)
        return 1
    from setup_tool.console import Console, SetupError
    from setup_tool.stamps import one_at_a_time
    from setup_tool.steps import Setup

    arguments = sys.argv[1:]
    unknown = [argument for argument in arguments if argument not in ("--dev", "--docs", "--begin")]
    if unknown:
        print(f"unknown argument {' '.join(unknown)}: expected --dev, --docs, --begin or nothing", file=sys.stderr)
        return 2
    root = Path(__file__).resolve().parent.parent
    begin = time.monotonic()
    with one_at_a_time(root, lambda: print("another set-up is running here, waiting for it", flush=True)) as lock:
        console = Console(root / ".venv/setup.log", lock)
        try:
            extras = [argument.removeprefix("--") for argument in arguments if argument != "--begin"]
            setup = Setup(root, console, wanted_python=os.environ.get("PYTHON", ""), extras=extras)
            if setup.is_complete():
                setup.mark_as_fresh()
                print("Everything is set up.", flush=True)
                return 0
            console.note("Setting up in .venv and ros_ws (once; all output is in .venv/setup.log)")
            setup.begin()
            if "--begin" in arguments:
                console.note(f"Begun in {time.monotonic() - begin:.0f} s; ROS 2 is set up in the background.")
                if os.fork():
                    return 0
                console.leave_terminal()
            setup.finish()
        except SetupError as error:
            console.show_failure(error)
            return 1
        except OSError as error:
            print(f"set-up stopped: {error}: is this folder yours, and is there space?", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            print("\nset-up was interrupted: call it again to go on", file=sys.stderr)
            return 130
        console.note(f"Set up in {time.monotonic() - begin:.0f} s.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
