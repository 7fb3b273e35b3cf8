"""ur_rtde's control client in a process of its own, run as a script: ``python _ur_control.py HOST FREQUENCY``.

A line [verb, arguments] in JSON comes in, [result] or [null, error] goes out. The process exists to be killed: when
packages stay away, the client reconnects by itself, restarts its program on the robot, may send the last command
again, and its disconnect() may never return (measured with ur_rtde 1.6.5, connection silent but not closed).
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any


def main() -> None:
    """Serve until the input ends."""
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # the client prints on standard output
    control: Any = None
    answer: list[Any]
    for line in sys.stdin:
        verb, arguments = json.loads(line)
        try:
            if verb == "connect":
                import rtde_control

                control = rtde_control.RTDEControlInterface(sys.argv[1], float(sys.argv[2]))
                answer = [True]
            else:
                answer = [getattr(control, verb)(*arguments)]
        except Exception as error:  # noqa: BLE001  # whatever it is, the driver reports it
            answer = [None, f"{error or type(error).__name__}"]
        replies.write(json.dumps(answer) + "\n")
    os._exit(0)  # the client's destructor may wait for ever


if __name__ == "__main__":
    main()
