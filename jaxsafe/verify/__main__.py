"""`python -m jaxsafe.verify` runs the command in `jaxsafe/commands/verify.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.verify import command

    command()
