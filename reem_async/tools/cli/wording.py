"""Errors in the words of the command line: what they advise a program to pass, as options of a command."""

from __future__ import annotations

import re

__all__ = ["for_users", "in_words"]

# What the messages of the library say, as regular expressions, and what a command says in its place. The tests
# look that each still stands in the library, and that no other message advises what cannot be typed.
_IN_THE_URL = "in --url or REEM_URL"
_WORDS = tuple(
    (re.compile(of_library), of_command)
    for of_library, of_command in (
        (r"RedisInterface\('(redis(?:\+cluster)?://host:port[^']*)'\)", r"--url \1 or REEM_URL"),
        (
            r"RedisInterface\(\.\.\., username=\.\.\., password=\.\.\.\)",
            "--url redis://user@host:port and REEM_PASSWORD, or user:password in REEM_URL",
        ),
        (r"RedisInterface\(\.\.\., largest_value=\) sets", f"?largest_value=BYTES {_IN_THE_URL} sets"),
        (
            r"pass it in RedisInterface\(ships=\[\.\.\.\]\)",
            "read it in a program that has this ship: RedisInterface(ships=[...])",
        ),
        (
            r"RedisInterface: .*unexpected keyword argument '(\w+)'; see redis-py's connection options",
            r"the URL of the server has an option \1, which redis-py does not know",
        ),
        (r"RedisInterface: (.*); see redis-py's connection options", r"the options in the URL of the server: \1"),
        (
            r"warnings\.filterwarnings\('ignore', category=reem\.InsecureConnection\)",
            "PYTHONWARNINGS=ignore::UserWarning",
        ),
        (
            r"pass ssl_certfile=\.\.\. and ssl_keyfile=\.\.\.",
            f"add ?ssl_certfile=FILE&ssl_keyfile=FILE to the address {_IN_THE_URL}",
        ),
        (r"pass ssl_ca_certs='ca\.crt'", f"add ?ssl_ca_certs=ca.crt to the address {_IN_THE_URL}"),
        (
            r"ssl_ca_certs='ca\.crt' instead of ssl_cert_reqs='none'",
            "?ssl_ca_certs=ca.crt in place of ?ssl_cert_reqs=none",
        ),
        (r"rediss:// or ssl=True", "rediss://"),
        (r"give it longer with timeout=", f"give it longer with ?socket_timeout=SECONDS {_IN_THE_URL}"),
        (r"use namespace= to", "use --namespace to"),
        (r"overwrite=True", "--force"),
        (r"replace=True replaces them, into= gives", "--replace replaces them, --into gives"),
        (r"port=0, or `reem up --port 0`, takes a free one", "`reem up --port 0` takes a free one"),
        (r"or sample=(?!\w)", "or --sample FILE"),
        (r"use append\(\) to make a list longer", "to make a list longer, set it as a whole"),
        (r"use str\(value\) or a float", "give it as text, with --str, or as a float: 1e20"),
    )
)


def for_users(error: Exception | Warning) -> str:
    """Return the message of an error, in the words of the command line."""
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return in_words(str(error) or type(error).__name__)


def in_words(message: str) -> str:
    """Return a message of the library in the words of the command line."""
    for of_library, of_command in _WORDS:
        message = of_library.sub(of_command, message)
    return message
