"""`python -m jaxsafe.config` runs the command in `jaxsafe/commands/config.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.config import command

    command()
