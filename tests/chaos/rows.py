"""Every row of the scoreboard: importing this enters them."""

from . import (  # noqa: F401
    atomic,
    calls,
    frames,
    hostile,
    model,
    outages,
    processes,
    recorder,
    refusals,
    restarts,
    soak,
    values,
)
