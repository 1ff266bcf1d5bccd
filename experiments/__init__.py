"""What was measured: a module a figure, a table or a study, run from the root of the repository.

    python -m experiments.paper.figure_5

``paper`` holds the figures and tables of the paper and of docs/results.md, ``studies`` what goes beyond them. Both
stand on ``common``, and neither on the other. Figures and numbers go to docs/paper; with SVG set in the environment
figures are written as SVG too.
"""
