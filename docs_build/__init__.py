"""What builds the documentation site: marked blocks, equations, diagrams, generated references.

mkdocs calls :mod:`docs_build.hooks`; the tests use the same functions.
"""
