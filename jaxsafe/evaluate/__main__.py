"""`python -m jaxsafe.evaluate` runs the command in `jaxsafe/commands/evaluate.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.evaluate import command

    command()
