"""Ask an address whether a Dask scheduler answers there, in a process of its own.

What answers may be anything: a program of another kind, which never says a word or sends nonsense.
The threads, tasks and messages that a failed attempt leaves end with this process, which
``scheduler_answers`` starts and ends. Its exit status is 0 if a scheduler answered.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any, cast

CONNECT_SECONDS = 5
"""Seconds in which an address has to accept a connection; Dask tries again meanwhile."""


def scheduler_answers(address: str, seconds: float) -> bool:
    """Return True if a Dask scheduler answers at an address within some seconds."""
    # -P: nothing is imported from the current folder.
    command = [sys.executable, "-P", "-m", "netkf.ensembles.ask_scheduler", address]
    nowhere = subprocess.DEVNULL
    try:
        process = subprocess.run(
            command, check=False, timeout=seconds, stdin=nowhere, stdout=nowhere, stderr=nowhere
        )
    except (subprocess.TimeoutExpired, ValueError):  # ValueError: a null character
        return False
    return process.returncode == 0


async def _kind(address: str) -> str:
    """Return the name of the class of server that answers, of Dask's."""
    from distributed import core, security

    connect, secure = cast(Any, core.rpc), cast(Any, security.Security)
    arguments = secure().get_connection_args("client")
    async with connect(address, timeout=CONNECT_SECONDS, connection_args=arguments) as server:
        identity = await server.identity()
    return str(identity["type"])


if __name__ == "__main__":
    import asyncio

    sys.exit(asyncio.run(_kind(sys.argv[1])) != "Scheduler")
