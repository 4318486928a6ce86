"""The wire format is the one that docs/wire.md has, byte for byte."""

import re

from wirekit import BLOCK, PAGE, captured, page_with

from reem_async.coordination import messages
from reem_async.plan import notices


def test_the_page_of_the_wire_format_is_what_servers_hold_and_receive():
    """If this fails after a change of the format: is it one that an older client would misread? Then raise VERSION.

    `python tests/wirekit.py` writes the examples of today.
    """
    text = PAGE.read_text(encoding="utf-8")
    examples = captured()
    assert sorted(found[0] for found in BLOCK.findall(text)) == sorted(examples)
    assert page_with(examples) == text
    assert re.search(r"^Version: (\d+)$", text, re.MULTILINE)[1] == str(notices.VERSION) == str(messages.VERSION)
