"""Photos without colour among photos with colour, of which a scene becomes grey in places."""

from querysplat_cli.runtime.words import counted
from querysplat_cli.scene.views import Views

NO_COLOUR, COLOUR = 1 / 255, 5 / 255
"""The mean difference of a photo's channels, of 1, up to which it has no colour, and from which it has some. A grey
picture has 0. The photos of fortress, kermit, dtu106, sceaux and riverview have 0.043 to 0.151."""


def colourless_warning(views: Views) -> tuple[str, ...]:
    """A sentence where some photos have no colour and others do; nothing otherwise."""
    spreads = {}
    for view, name in enumerate(views.names):
        picture, mask = views.picture(view), views.masks[view]
        if mask.any():
            spreads[name] = float((picture.amax(0) - picture.amin(0))[mask].mean())
    grey = [name for name, spread in spreads.items() if spread <= NO_COLOUR]
    if not grey or max(spreads.values()) < COLOUR:
        return ()
    has = "has" if len(grey) == 1 else "have"
    among = f"{counted(len(grey), 'photo')} of {len(views)} {has} no colour, such as {grey[0]}"
    return (f"{among}, so the scene is grey in places; leave out those, or the others",)
