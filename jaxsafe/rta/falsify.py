"""`python -m jaxsafe.rta.falsify` runs the command in `jaxsafe/commands/falsify.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.falsify import command

    command()
