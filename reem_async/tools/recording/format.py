"""What a message of a recording says and where it came from, and the errors of recordings.

The texts of roles and kinds are in the files: they never change.
"""

from __future__ import annotations

from enum import StrEnum

from ...errors import BadData, ReemError


class RecordingFailed(ReemError):
    """The file could not be written any further (disk full, ...); what was written until then can be read."""


class DamagedRecording(BadData):
    """The file is not a recording of REEM, or the part asked for was damaged."""


class Role(StrEnum):
    """What a message says; the metadata of its channel has it as `reem.role`."""

    UPDATE = "update"
    """What is now at the path."""
    PART = "part"
    """A piece that an update or a state refers to: an array, bytes, a long list."""
    DELETE = "delete"
    """What was at the path is gone."""
    STATE = "state"
    """The whole key as it was read from the server; while it waits to be written, MISSING if the key is gone."""
    KEYFRAME = "keyframe"
    """The whole key as the recording has it: what is asked about an instant begins at the last one before."""
    GAP = "gap"
    """Updates of the key were lost."""
    SKIP = "skip"
    """An update of the path is not recorded, since it was changed before it could be read."""

    # What waits to be written besides, and is something else, or nothing, in the file.

    STORED = "stored"
    """The whole key, of which a client has changed something and published nothing; in the file, of what differs, an
    update or a deletion."""
    SAMPLE = "sample"
    """What was read at a path in turn; in the file an update or a deletion."""
    SPLIT = "split"
    """The next file begins."""
    FOUND = "found"
    """What a read found at the place of a skipped update; in the file an update or a deletion."""


NEWS = (Role.UPDATE, Role.DELETE, Role.STATE)
"""The roles that say something new; a keyframe only repeats."""


class Kind(StrEnum):
    """Where a message came from; the metadata of its channel has it as `reem.kind`."""

    PUBLISHED = "pub"
    STORED = "stored"
    """A client changed what is stored, and published nothing."""
    READ = "kvs"
    """It was sampled or read from the server: its writer is unknown."""
