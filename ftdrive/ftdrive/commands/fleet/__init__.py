"""`ftdrive fleet`: many cells, from the store that they share."""
