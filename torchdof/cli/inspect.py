"""``torchdof inspect``: reports on a depth map, its blur by a camera, and likely mistakes."""

from pathlib import Path

from ..io.atomic import check_writable
from .command import Command, argument, option
from .options import Scene, check_files
from .output import Notices, print_result


class Inspect(Scene, Command):
    """Report on a depth map and its blur by a camera, before anything is rendered.

    Prints ranges, blur radii, the share in focus, holes, and how many edges of the depth match edges of the image.
    Draws depth, blur, doubtful edges, and the blur with these repaired. The defaults of focus and lens are those of
    torchdof render.

        torchdof inspect photo.jpg depth.png --depth-scale 0.001 --focus-at 320,200 --f-number 1.8
    """

    image: Path = argument("All-in-focus image, as for torchdof render.", "IMAGE")
    depth: Path | None = argument("Its depth; not needed if IMAGE has a Z channel.", "[DEPTH]", None)
    out: Path | None = option("Picture to write; default: IMAGE.inspect.png, in this folder.", names=("--out", "-o"))

    def run(self) -> None:
        """Prints the report, and draws it."""
        self.refuse_keyframes()
        if self.depth_kind == "coc":
            raise ValueError("--depth-kind coc is the blur itself: there is no depth to inspect")
        target = Path(f"{self.image.stem}.inspect.png") if self.out is None else self.out
        check_files(self.image, self.depth, target)
        check_writable(target)
        from ..depth.inspect import inspect_depth, panels
        from ..io.sheet import write_sheet
        from .frame import read_frame

        frame = read_frame(self.image, self.depth, self, holes=True)
        scene = frame.scene
        light, metres = frame.picture.light, frame.values
        if not bool((metres > 0).any()):
            raise ValueError(f"{frame.name}: no pixel has a depth; check the kind, scale and offset of the depth map")
        camera, notes = scene.camera(frame)
        notes += frame.remarks
        report = inspect_depth(light, metres, camera)
        write_sheet(target, panels(light, report))
        height, width = metres.shape[-2:]
        lines = [f"image         {width} x {height} px, {', '.join(frame.picture.channels)}"]
        lines += [f"camera        {camera!r}" + (f" [{', '.join(notes)}]" if notes else ""), str(report)]
        if frame.filled:
            share = 100 * frame.filled / metres.numel()
            lines.append(f"filled        {frame.filled} holes ({share:.1f} %), {scene.fill_depth}")
        lines.append(f"picture       {target}")
        facts = {"image": str(self.image), "width": width, "height": height, "camera": vars(camera)}
        facts |= {"assumed": notes, **report.facts(), "filled_px": frame.filled, "picture": str(target)}
        print_result(self.as_json, facts, "\n".join(lines))
        notices = Notices(self.strict)
        if frame.guess:
            notices.note("guess", f"{frame.name}: {frame.guess}")
        notices.warn(frame.name, frame.mistakes(camera))
