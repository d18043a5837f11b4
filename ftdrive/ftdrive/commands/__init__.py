"""Commands of `ftdrive`, one module each, which is imported only when its command is called."""
