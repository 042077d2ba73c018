"""The commands, one file each. Nothing else imports them."""
