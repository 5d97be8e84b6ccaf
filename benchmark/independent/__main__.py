"""`python -m benchmark.independent`."""

from benchmark.independent.run import main

if __name__ == '__main__':
    main()
