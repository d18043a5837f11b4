"""The page of a command in the browser: one server, one address, one page. It looks and may stop an arm; it moves none.

`page` serves it behind the gate, `scene` draws the cell. Each other module fills the page of one or two commands.
"""
