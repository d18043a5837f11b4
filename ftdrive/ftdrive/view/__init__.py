"""The page of a command in the browser. It shows the command and may stop an arm, but never moves one.

`page` holds the parts and controls of a page, `site` serves them to browsers, `parts` and `scene` create them, and
`shell` contains the files for the browser. Each other module fills the page of one command.
"""
