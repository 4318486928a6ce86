"""The errors, the same for both fronts; see `reem_async.errors`."""

from reem_async.errors import *  # noqa: F403
from reem_async.errors import __all__ as __all__
