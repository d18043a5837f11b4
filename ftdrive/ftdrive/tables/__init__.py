"""Reading of tables from other programs: text formats, columns and units."""
