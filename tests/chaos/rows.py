"""Every row of the scoreboard: importing this enters them."""

from . import (  # noqa: F401
    calls,
    frames,
    outages,
    restarts,
)
