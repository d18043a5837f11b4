"""Reading of tables from other programs: recognition of their text formats, columns and units."""
