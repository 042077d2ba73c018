"""`python -m jaxsafe.export` runs the command in `jaxsafe/commands/export.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.export import command

    command()
