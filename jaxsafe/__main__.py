"""`python -m jaxsafe COMMAND` is the console script `jaxsafe COMMAND`."""

if __name__ == "__main__":
    from jaxsafe.commands import main

    main()
