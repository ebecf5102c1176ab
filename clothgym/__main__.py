"""``python -m clothgym``."""

from clothgym.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
