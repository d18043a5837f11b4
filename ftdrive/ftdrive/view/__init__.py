"""The page of a command in the browser: one server, one address, one page. It looks and may stop an arm; it moves none.

`page` has the parts and controls of a page, `site` serves them to browsers, `parts` and `scene` make them, and `shell`
is what a browser loads. Each other module fills the page of one command.
"""
