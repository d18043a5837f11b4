"""Tables of other programs: which text, which columns, which units."""
