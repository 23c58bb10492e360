"""A window that shows the newest frame; needs Python's tkinter and a display."""

from __future__ import annotations

from collections.abc import Callable

from cvthead_client.errors import CVTHeadClientError
from cvthead_client.media import Rgb

POLL_MILLISECONDS = 15


def show(newest: Callable[[], Rgb | None], title: Callable[[], str]) -> None:
    """Show frames until the user closes the window or presses Escape.

    Args:
        newest: the frame to show, None if there is no newer one; raises StopIteration at the end.
        title: of the window, asked for with every frame.

    Raises:
        CVTHeadClientError: there is no display.
    """
    try:
        import tkinter

        root = tkinter.Tk()
    except (ImportError, RuntimeError) as error:  # TclError is a RuntimeError before 3.13
        raise _no_display(error) from error
    except Exception as error:
        if type(error).__name__ != "TclError":
            raise
        raise _no_display(error) from error
    root.title(title())
    label = tkinter.Label(root, borderwidth=0)
    label.pack()
    root.bind("<Escape>", lambda _: root.destroy())
    picture: tkinter.PhotoImage | None = None

    def poll() -> None:
        nonlocal picture
        try:
            image = newest()
        except StopIteration:
            root.destroy()
            return
        if image is not None:
            height, width = image.shape[:2]
            # The reference keeps Tk's picture alive.
            picture = tkinter.PhotoImage(data=b"P6 %d %d 255\n" % (width, height) + image.tobytes())
            label.configure(image=picture)
            root.title(title())
        root.after(POLL_MILLISECONDS, poll)

    poll()
    root.mainloop()


def _no_display(error: Exception) -> CVTHeadClientError:
    return CVTHeadClientError(f"no window can be opened ({error})", hint="use --output out.mp4")
