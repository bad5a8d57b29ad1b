"""`python -m pathjax`."""

import gc
import sys


def main() -> int:
    """The command line, deaf to Ctrl-C at no time: importing JAX takes a while."""
    try:
        from pathjax import cli

        gc.freeze()  # modules live to the end; to search them for garbage, at exit too, takes a fifth of a second
        return cli.main()
    except KeyboardInterrupt:
        print("pathjax: interrupted; nothing was written", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
