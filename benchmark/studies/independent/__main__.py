"""`python -m benchmark.studies.independent`."""

from benchmark.studies.independent.run import main

if __name__ == '__main__':
    main()
