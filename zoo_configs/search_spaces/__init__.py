"""Search spaces of ``tune``, a file per algorithm."""
