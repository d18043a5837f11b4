"""What ftdrive knows, in the languages of others: one module a target, from an object of ours to the text of a file."""
