"""`python -m jaxsafe.plot` runs the command in `jaxsafe/commands/plot.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.plot import command

    command()
