"""`ftdrive fleet`: many cells, from the store that all of them share."""
