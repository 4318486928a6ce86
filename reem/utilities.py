"""Where functions on paths and nested dicts were in REEM 0.0.x and 0.1.x."""

from .legacy import (
    ROOT_PATH,
    ROOT_VALUE_SEQUENCE,
    SEPARATOR_CHARACTER,
    append_to_path,
    check_valid_key_name,
    check_valid_key_name_ext,
    copy_dictionary_without_paths,
    extract_object,
    filter_paths_by_prefix,
    insert_into_dictionary,
    key_sequence_to_path,
    key_sequence_to_path_ext,
    path_to_key_sequence,
)  # fmt: skip

__all__ = [
    "ROOT_PATH", "ROOT_VALUE_SEQUENCE", "SEPARATOR_CHARACTER", "append_to_path", "check_valid_key_name",
    "check_valid_key_name_ext", "copy_dictionary_without_paths", "extract_object", "filter_paths_by_prefix",
    "insert_into_dictionary", "key_sequence_to_path", "key_sequence_to_path_ext", "path_to_key_sequence",
]  # fmt: skip
