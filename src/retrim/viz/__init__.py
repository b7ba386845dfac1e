"""Pictures; nothing else imports this but the command line."""
