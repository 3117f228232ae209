"""``python -m jumplab`` and ``jumplab``: the command line."""

import os
import signal
import sys


def main() -> int:
    """Run the command that was typed; a signal while it is still being imported ends it without a
    word.
    """
    while (spare := os.open(os.devnull, os.O_RDWR)) <= 2:
        # a standard stream was closed; no file of ours must get its number
        os.set_inheritable(spare, True)
    os.close(spare)
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_, code=code: os._exit(code))
    from jumplab.cli.main import main as work

    return work()


if __name__ == "__main__":
    sys.exit(main())
