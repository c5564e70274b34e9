"""``torchdof tables``: lists blur tables."""

from .command import Command, argument
from .options import named_table
from .output import print_result


class Tables(Command):
    """List blur tables: name, family, number of distances, opening and source.

        torchdof tables my_lens.json --json

    Without names it lists all that ship.
    """

    names: tuple[str, ...] = argument("Names or JSON files; default: all that ship.", "[TABLE]...", ())

    def run(self) -> None:
        """Prints a line for each table."""
        from ..optics.blur_table import shipped

        for name in self.names or ["disc", "gaussian", *shipped()]:
            table = named_table(name)
            source = str(table.provenance.get("source", "")).partition(";")[0]
            facts = {"table": name, "family": table.family, "nodes": len(table.coc), "coc": table.coc[[0, -1]].tolist()}
            facts |= {"unit": table.unit, "colours": table.channels, "source": source}
            facts |= {"aperture": table.aperture and repr(table.aperture), "field": table.field and repr(table.field)}
            parts = [table.family, f"{len(table.coc)} node{'s' if len(table.coc) > 1 else ''}"]
            parts += [str(part) for part in (table.aperture, table.field) if part is not None]
            line = f"{name:24s} {', '.join(parts)}" + (f" ({source})" if source else "")
            print_result(self.as_json, facts, line)
