"""What a server may show, and what it must not."""

from served import Answer

SECRET = b"nobody may read this"


WEB = {"index.html": b"<title>Web</title>", "viewer.js": b"0", "viewer.js.gz": b"1", "nodes/a1.spz": b"NGSP"}


REFUSED = {400, 403, 404, 405, 411, 413, 414, 415, 416, 421, 431}


def refused(answer: Answer) -> bool:
    """Whether a request was turned down, without a secret or a traceback."""
    return answer.status in REFUSED and SECRET not in answer.body and b"Traceback" not in answer.body
