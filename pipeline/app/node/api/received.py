"""Files of a multipart body on their way into a task."""

from __future__ import annotations

from collections.abc import Mapping

from splatpipe.pipeline.app.node.api.multipart import BadBodyError
from splatpipe.pipeline.app.node.tasks.node import Node
from splatpipe.pipeline.app.node.tasks.uploads import PartFile


class UploadedFile:
    """A file of a task that was begun.

    Args:
        node: The node.
        part: Where it goes; None if it is read and not kept.
        limit: The most bytes it may have.
    """

    def __init__(self, node: Node, part: PartFile | None, limit: int) -> None:
        self._node, self._part, self._limit, self._size = node, part, limit, 0

    @staticmethod
    def begin(node: Node, uuid: str, name: str, _fields: Mapping[str, str]) -> UploadedFile:
        """Begin to receive a file; raises as ``Node.begin_file``."""
        return UploadedFile(node, node.begin_file(uuid, name), node.limit_of(name))

    def write(self, data: bytes) -> None:
        """Take the next bytes.

        Raises:
            BadBodyError: if the file is too large.
            OSError: if the disk is full.
        """
        self._size += len(data)
        if self._size > self._limit:
            raise BadBodyError(f"A file is larger than the {self._limit / 1e9:.1f} GB that are allowed.")
        if self._part is not None:
            self._node.reserve(len(data))
            self._part.write(data)

    def finish(self) -> None:
        """Give the file its name; raises as ``PartFile.finish``."""
        if self._part is not None:
            self._part.finish()

    def discard(self) -> None:
        """Forget what was received."""
        if self._part is not None:
            self._part.discard()


def refuse_files(name: str, _fields: Mapping[str, str]) -> UploadedFile:
    """Take no file.

    Raises:
        BadBodyError: always.
    """
    raise BadBodyError(f'The file "{name[:60]}" comes too early: it belongs into an upload.')
