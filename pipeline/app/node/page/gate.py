"""Who may use the page: the token, or the key in the printed address, is exchanged for a cookie.

As in ``splatpipe view`` (app/view/access.py says why): our pages are below a folder of random name, to which the cookie
belongs; files of a run, which may be somebody else's pages, are below another that only their own addresses name, and
run in a sandbox. Both outlive the node's process, so that a restart of the node asks nobody for anything: they derive
from a secret in the node's folder, and from the token, so that a new token ends all sessions.
"""

from __future__ import annotations

import hmac
import os
import secrets
from dataclasses import dataclass, field
from pathlib import Path

from starlette.datastructures import Headers

from splatpipe.pipeline.app.serving.refusals import RefusedError, same
from splatpipe.pipeline.app.view.access import Access
from splatpipe.pipeline.engine.files.small_file import read_small

COOKIE = "splatpipe-node"
SECRET_FILE = "page.secret"
SECRET_LETTERS = 64
OURS, RESULTS = "page", "results"  # first folders of addresses: our pages, files of runs
COOKIE_DAYS = 30
SAME_ORIGIN = ("same-origin", "none")  # of Sec-Fetch-Site: our own page, or the address bar


@dataclass(frozen=True)
class PageAccess:
    """The secrets of a node's page.

    Attributes:
        token: The node's token; empty for none.
        pages: Folder of our pages, below ``/page/``.
        cookie: The cookie's value.
        keys: The key in the printed address and that of the opened browser.
    """

    token: str = field(repr=False)
    secret: str = field(repr=False)
    keys: Access = field(default_factory=Access, repr=False)

    @property
    def pages(self) -> str:
        return self._derived("pages")

    @property
    def cookie(self) -> str:
        return self._derived("cookie")

    @property
    def address(self) -> str:
        """The page's address on this host."""
        return f"/{OURS}/{self.pages}/"

    def results(self, uuid: str) -> str:
        """The folder of a task's files; it tells nothing about that of another task."""
        return f"{RESULTS}/{uuid}/{self._derived(f'results {uuid}')}"

    def opens_results(self, uuid: str, given: str) -> bool:
        """Whether an address names the folder of a task's files."""
        return same(given.encode(), self._derived(f"results {uuid}"))

    def takes(self, token: str) -> bool:
        """Whether a token is the node's."""
        return bool(self.token) and same(token.encode("utf-8", "replace"), self.token)

    def set_cookie(self, *, encrypted: bool) -> str:
        """The value of the Set-Cookie header.

        Args:
            encrypted: Whether the browser speaks TLS, to a proxy in front of the node.
        """
        kept = f"Max-Age={COOKIE_DAYS * 86_400}; HttpOnly; SameSite=Strict"
        return f"{COOKIE}={self.cookie}; Path=/{OURS}/{self.pages}; {kept}{'; Secure' if encrypted else ''}"

    def require_ours(self, headers: Headers, pages: str) -> None:
        """Check that a request comes from our own page, in a browser that has the cookie.

        Raises:
            RefusedError: if not.
        """
        pairs = (pair.strip().partition("=") for pair in headers.get("cookie", "").split(";"))
        has_cookie = any(same(value.encode(), self.cookie) for name, _, value in pairs if name == COOKIE)
        if not same(pages.encode(), self.pages) or not has_cookie:
            raise RefusedError(403, "Open the node's page again: this browser is not known to it.")
        require_own_origin(headers)

    def _derived(self, what: str) -> str:
        return hmac.new(f"{self.secret}\n{self.token}".encode(), what.encode(), "sha256").hexdigest()[:32]


def require_own_origin(headers: Headers) -> None:
    """Check that no page of another origin sends a request; a proxy may have changed scheme and Host.

    Raises:
        RefusedError: if one does.
    """
    site, origin, host = headers.get("sec-fetch-site"), headers.get("origin"), headers.get("host", "")
    if site is not None:
        if site not in SAME_ORIGIN:
            raise RefusedError(403, "Request from another site refused.")
    elif origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        raise RefusedError(403, "Request from another page refused.")


def page_access(folder: Path, token: str) -> PageAccess:
    """The secrets of the page of a node.

    Args:
        folder: The node's folder; its secret is made there once.
        token: The node's token; empty for none.

    Raises:
        OSError: if the secret cannot be read or written.
    """
    return PageAccess(token, _secret(folder))


def own_token(folder: Path) -> str:
    """The token of a node for one person, who does not have to know it: the same whenever it is started.

    Raises:
        OSError: if the folder's secret cannot be read or written.
    """
    return hmac.new(_secret(folder).encode(), b"own token", "sha256").hexdigest()[:32]


def _secret(folder: Path) -> str:
    path = folder / SECRET_FILE
    try:
        secret = read_small(path, 2 * SECRET_LETTERS).decode("ascii").strip()
    except (FileNotFoundError, UnicodeDecodeError):
        secret = ""
    if len(secret) != SECRET_LETTERS:
        secret = secrets.token_hex(SECRET_LETTERS // 2)
        path.unlink(missing_ok=True)  # a half one
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600), "w") as file:
            file.write(secret)
    return secret
