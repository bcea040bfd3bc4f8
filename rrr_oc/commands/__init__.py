"""The commands of `rrr-oc`, one a module, each imported when it is used: help and mistakes in typing are answered at once.

A module has a `typer.Typer` named `app`, made without completion, whose functions are the command or its subcommands. It appears
in `rrr-oc` by its row in `COMMANDS`. `shared` has what several of them need.

Imports everything else; a module here imports at its top what its options need, and the rest where the command runs, within
`ends_at_once`."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from rrr_oc import __version__
from rrr_oc.errors import STATUSES, UserError, ends_at_once, meant

# Names of the commands in the order of the help, each with its module and a sentence for the list of commands.
COMMANDS = {
    "demo": ("tour.demo", "A tour in about a minute: the diagnosis of an arm with hidden physics, and a spring for it."),
    "init": ("init", "Commented example files for an arm, and the next commands."),
    "design": ("design", "Springs and motion of a task, designed together."),
    "check": ("check", "Signs, order, units and clocks of a recording set's columns, and what its motions do not show."),
    "calibrate": ("calibrate", "Friction and armature of every joint, and inertial parameters where the set asks for them."),
    "diagnose": ("diagnose", "Where a calibrated model fails, which physics it lacks, and how well it predicts with it."),
    "evaluate": ("evaluate", "How well a model predicts recordings, from the measured motion or in simulation."),
    "simulate": ("simulate", "A model in MuJoCo tracks recordings; what it does is written and compared."),
    "excite": ("excite", "A motion to record, which determines friction and inertia of an arm within its limits."),
    "export": ("models.export", "A model for other programs: MJCF for plain MuJoCo, and URDF with identified inertias."),
    "compare": ("models.compare", "What differs between two diagnoses, models or designs by more than its error."),
    "animate": ("moving.animate", "A design or a recording as a moving picture."),
    "view": ("moving.view", "A task, a design or recordings in the browser, beside the model's simulation."),
    "effects": ("effects", "The catalogue of effects: laws, parameters and units."),
    "import": ("importers", "Recordings in other layouts, made into a recording set."),
}


class Commands(TyperGroup):
    """Lists commands by their rows in `COMMANDS` and imports the one that is called."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command's name and sentence, without its options."""
        return TyperCommand(cmd_name, help=COMMANDS[cmd_name][1]) if cmd_name in COMMANDS else None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in COMMANDS and not args[0].startswith("-") and (question := meant(args[0], COMMANDS)):
            ctx.fail(f"No such command {args[0]!r}{question}")
        name, found, rest = super().resolve_command(ctx, args)
        return name, found and load(found.name or ""), rest


def load(name: str) -> Any:
    """The command of a name in `COMMANDS`, with its options."""
    with ends_at_once():
        module = import_module(f"{__name__}.{COMMANDS[name][0]}")
    return typer.main.get_command(module.app)


def run(words: Sequence[str]) -> None:
    """Run a command as it would be typed behind `rrr-oc`, in this process; raises `UserError` for values that an option does not take."""
    name, *rest = words
    try:
        load(name).main(list(rest), prog_name=f"rrr-oc {name}", standalone_mode=False)
    except typer.BadParameter as error:
        raise UserError(error.format_message()) from None


def _version(asked: bool) -> None:
    if asked:
        typer.echo(__version__)
        raise typer.Exit


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit status: " + "; ".join(f"{status}: {meaning}" for status, meaning in STATUSES.items()) + ".",
)


@app.callback()
def rrr_oc(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Show the version and exit."),
) -> None:
    """Springs for robot arms, and what their simulation lacks: co-design, calibration and diagnosis on recordings."""
