"""A way to a server through TLS, for a user with few rights."""

from __future__ import annotations

import contextlib
import re
import tempfile
from pathlib import Path

from chaos.proxy import Proxy
from conftest import ROOT
from test_secured import Certificates, context_for

from .checks import Server
from .clients import Address


def secured(stack: contextlib.ExitStack, server: Server) -> Address:
    """Return the address of a proxy with TLS before a server, for a user with the commands of deploy/users.acl."""
    line = re.search(r"^user robot .*", (ROOT / "deploy/users.acl").read_text(), re.MULTILINE)
    assert line is not None
    commands = [word for word in line[0].split() if word.startswith("+")]
    server.raw.execute_command("ACL", "SETUSER", "robot", "on", ">secret", "~*", "&*", "-@all", *commands)
    certificates = Certificates(Path(stack.enter_context(tempfile.TemporaryDirectory())))
    target = int(server.url.rpartition(":")[2])
    proxy = stack.enter_context(Proxy(target, ssl=context_for(certificates.server)))
    return f"rediss://robot:secret@127.0.0.1:{proxy.port}", {"ssl_ca_certs": certificates.ca}
