"""Implements ``micron tremor``: it inspects recorded hands and evaluates estimators on them."""

from __future__ import annotations

import typer

from tools.research.cli import tremor_budget, tremor_evaluate, tremor_inspect, tremor_report, tremor_train

app = typer.Typer(help="Inspect recorded hands, train on them, and evaluate estimators.")
app.command("inspect")(tremor_inspect.inspect)
app.command("evaluate")(tremor_evaluate.evaluate)
app.command("train")(tremor_train.train)
app.command("report")(tremor_report.report)
app.command("budget")(tremor_budget.budget)
