"""The pages for people: what is code in them runs, what is a command is one."""
