"""Find out in a separate process whether a Dask scheduler answers at an address.

The server there may be any program, which never answers or sends garbage. The threads, tasks and
messages that a failed attempt leaves behind end with that process, which runs this module and is
started by ``scheduler_answers``. Its exit status is 0 if a scheduler answered.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any, cast

CONNECT_SECONDS = 5
"""Seconds in which the server has to accept a connection; Dask tries again until then."""


def scheduler_answers(address: str, seconds: float) -> bool:
    """Return True if a Dask scheduler answers within ``seconds``, asked by another process."""
    # -P keeps Python from importing modules of the current folder.
    command = [sys.executable, "-P", "-m", "netkf.ensembles.ask_scheduler", address]
    null = subprocess.DEVNULL
    try:
        process = subprocess.run(
            command, check=False, timeout=seconds, stdin=null, stdout=null, stderr=null
        )
    except (subprocess.TimeoutExpired, ValueError):  # ValueError: the address has a null character
        return False
    return process.returncode == 0


async def _server_class(address: str) -> str:
    """Return the name of the class of Dask's server at an address, such as ``Scheduler``.

    Raises an exception of Dask or of asyncio if no server of Dask's answers.
    """
    from distributed import core, security

    connect, secure = cast(Any, core.rpc), cast(Any, security.Security)
    arguments = secure().get_connection_args("client")
    async with connect(address, timeout=CONNECT_SECONDS, connection_args=arguments) as server:
        identity = await server.identity()
    return str(identity["type"])


if __name__ == "__main__":
    import asyncio

    sys.exit(asyncio.run(_server_class(sys.argv[1])) != "Scheduler")
