"""Runs of one scene on machines, in shells and with interpreters of many kinds, which must give the same bits."""
