"""Look at a result at full resolution."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from cuspid import storage
from cuspid.cli.shared import console
from cuspid.report.live_view import serve
from cuspid.report.same_origin import address
from cuspid.runtime.options import Range


def view(
    folder: Annotated[Path, Positional],
    *,
    reference: Path | None = None,
    unit: storage.Unit = "mm",
    host: str = "127.0.0.1",
    port: Annotated[int, Range(1, 65_535)] = 8080,
) -> None:
    """Show a scan or a shape model in the browser, with all its faces, until Ctrl-C. Needs the extra cuspid[view].

    Args:
        folder: Folder that run, reconstruct, evaluate or shape wrote.
        reference: Mesh that the scan was compared with, if the folder does not contain it (after evaluate).
        unit: Length unit of the reference.
        host: Address to listen on; 0.0.0.0 accepts connections from other machines.
        port: Port to listen on; if it is in use, the next free one is taken.
    """
    server = serve(storage.read_result(folder, reference, unit), host, port)
    console.print(
        f"{address(host, server.get_port())} shows {folder}; press Ctrl-C to stop", highlight=False, soft_wrap=True
    )
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        server.stop()
