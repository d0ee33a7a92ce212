"""Who may use the server: its secrets, the address that carries one, and the cookie that it is exchanged for.

Every user of the machine can connect to 127.0.0.1, so a connection says nothing about who it is from. The printed
address carries a key; whoever has it receives a cookie and is sent on to an address without the key. Three more things
are secret, each for its own reason:

- Browsers send a cookie of 127.0.0.1 to every port, so to other people's servers as well, unless its path differs:
  our pages are below a folder that only their addresses name.
- Files of the run may be somebody else's pages. They are below another folder, are read without the cookie, and run in
  a sandbox that the cookie is never sent from (guard.py): knowing their own address, they know nothing of ours.
- The command line of the browser that is opened can be read by every user. The key in it counts only in connections
  from processes of this user, which the kernel tells.
"""

from __future__ import annotations

import os
import secrets
import socket
import struct
from dataclasses import dataclass, field
from pathlib import Path

from splatpipe.pipeline.app.serving.refusals import same

COOKIE = "splatpipe"
KEY = "?key="
ROOT_USER = 0
ESTABLISHED = "01"


def _secret() -> str:
    return secrets.token_hex(16)


@dataclass(frozen=True)
class Access:
    """The secrets of one server.

    Attributes:
        key: The key in the printed address.
        own_key: The key in the address that the opened browser is given.
        cookie: The cookie that a key is exchanged for.
        pages: Folder of our pages in the server's addresses.
        files: Folder of the run's files in the server's addresses.
    """

    key: str = field(default_factory=_secret, repr=False)
    own_key: str = field(default_factory=_secret, repr=False)
    cookie: str = field(default_factory=_secret, repr=False)
    pages: str = field(default_factory=_secret, repr=False)
    files: str = field(default_factory=_secret, repr=False)

    def opens(self, query: bytes, client: tuple[str, int] | None, server: tuple[str, int | None] | None) -> bool:
        """Whether the query of an address carries a key that counts.

        Args:
            query: The query, without its question mark.
            client: Address and port that the request comes from.
            server: Address and port that it was sent to.
        """
        given = b"?" + query
        if same(given, KEY + self.key):
            return True
        return same(given, KEY + self.own_key) and user_of(client, server) in (os.geteuid(), ROOT_USER)

    def has_cookie(self, header: str) -> bool:
        """Whether a Cookie header has ours; another server of this host may have added some of the same name."""
        pairs = (pair.strip().partition("=") for pair in header.split(";"))
        return any(same(value.encode(), self.cookie) for name, _, value in pairs if name == COOKIE)

    def set_cookie(self) -> str:
        """The value of the Set-Cookie header."""
        return f"{COOKIE}={self.cookie}; Path=/{self.pages}; HttpOnly; SameSite=Strict"


def user_of(client: tuple[str, int] | None, server: tuple[str, int | None] | None) -> int | None:
    """The user at the other end of a TCP connection within this machine; None if it cannot be told.

    The kernel lists the owner of every socket (proc(5), /proc/net/tcp); a client may use an IPv6 socket for IPv4.

    Args:
        client: IPv4 address and port of the other end.
        server: IPv4 address and port of our end.
    """
    if client is None or server is None or server[1] is None:
        return None
    for table, prefix, form in (("tcp", "", "=I"), ("tcp6", "::ffff:", "=4I")):
        try:
            ends = [_listed(prefix + host, form, port) for host, port in (client, (server[0], server[1]))]
            lines = Path("/proc/net", table).read_text(encoding="ascii").splitlines()[1:]
        except (OSError, ValueError):
            continue
        for fields in (line.split() for line in lines):
            if fields[1:4] == [*ends, ESTABLISHED]:
                return int(fields[7])
    return None


def _listed(host: str, form: str, port: int) -> str:
    """An address as the kernel lists it: words of the machine's byte order, in hexadecimal."""
    packed = socket.inet_pton(socket.AF_INET6 if ":" in host else socket.AF_INET, host)
    return "".join(f"{word:08X}" for word in struct.unpack(form, packed)) + f":{port:04X}"
