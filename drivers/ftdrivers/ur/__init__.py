"""Universal Robots arms."""
