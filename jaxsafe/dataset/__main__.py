"""`python -m jaxsafe.dataset` runs the command in `jaxsafe/commands/dataset.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.dataset import command

    command()
