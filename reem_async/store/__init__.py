"""One nested dictionary: its places, top-level keys, and what writes, reads and publishes them."""
