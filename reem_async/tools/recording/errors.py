"""What can go wrong with a recording itself."""

from __future__ import annotations

from ...errors import BadData, ReemError


class RecordingFailed(ReemError):
    """The file could not be written any further (disk full, ...); what was written until then can be read."""


class DamagedRecording(BadData):
    """The file is not a recording of REEM, or the part asked for was damaged."""
