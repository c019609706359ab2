"""`python -m controller`: the console, for where the command `truecell` is not on the path."""

from controller.console.app import main

if __name__ == "__main__":
    main()
