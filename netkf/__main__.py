"""``python -m netkf`` is ``netkf``."""

from netkf.cli.main import main

if __name__ == "__main__":
    main()
