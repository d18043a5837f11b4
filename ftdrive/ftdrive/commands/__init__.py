"""Commands of the application, one module each, imported only when called."""
