"""`python -m ftdrive`."""

from ftdrive.cli import main

raise SystemExit(main())
