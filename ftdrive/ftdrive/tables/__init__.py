"""Reading of tables of other programs: text formats, columns and units."""
