"""The browser page of a command. It shows what the command does and can stop an arm, but never moves one.

`page` holds the parts and controls of a page, `site` serves them to browsers, `parts` and `scene` create them, and
`shell` contains the browser's files. Each of the other modules fills the page of one command.
"""
