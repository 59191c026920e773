"""The textures of the flat, made once per scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magic_core.data.synthetic import pictures, textures
from magic_core.data.synthetic.textures import Texture


@dataclass(frozen=True, slots=True)
class Materials:
    """Named surfaces; pictures and books come in several variants."""

    oak: Texture
    walnut: Texture
    pine: Texture
    white_paint: Texture
    dark_metal: Texture
    steel: Texture
    ceiling: Texture
    skirting: Texture
    parquet: Texture
    planks: Texture
    kitchen_tiles: Texture
    carpet: Texture
    living_wall: Texture
    accent_wall: Texture
    kitchen_wall: Texture
    backsplash: Texture
    bedroom_wall: Texture
    study_wall: Texture
    study_bricks: Texture
    sofa: Texture
    armchair: Texture
    cushions: tuple[Texture, ...]
    duvet: Texture
    linen: Texture
    curtain: tuple[Texture, ...]
    rugs: tuple[Texture, ...]
    worktop: Texture
    cabinet: Texture
    cabinet_fronts: Texture
    drawers: Texture
    wardrobe: Texture
    door: Texture
    books: tuple[Texture, ...]
    paintings: tuple[Texture, ...]
    posters: tuple[Texture, ...]
    clock: Texture
    screen: Texture
    television: Texture
    window: Texture
    shade: Texture
    glow: Texture
    leaf: tuple[Texture, ...]
    terracotta: Texture
    ceramics: tuple[Texture, ...]
    fruit: tuple[Texture, ...]
    globe: Texture


def make_materials(rng: np.random.Generator) -> Materials:
    """All textures of the flat; the same generator state gives the same flat."""
    oak = textures.wood(rng, (196, 154, 104))
    walnut = textures.wood(rng, (112, 76, 52), contrast=1.3)
    pine = textures.wood(rng, (222, 188, 140), contrast=0.9)
    cabinet = textures.wood(rng, (118, 146, 140), contrast=0.35)
    return Materials(
        oak=oak,
        walnut=walnut,
        pine=pine,
        white_paint=textures.plaster(rng, (236, 233, 226), strength=2.0),
        dark_metal=textures.plaster(rng, (52, 54, 60), strength=2.5),
        steel=textures.wood(rng, (176, 180, 184), contrast=0.5),
        ceiling=textures.plaster(rng, (240, 238, 232), strength=3.0),
        skirting=textures.plaster(rng, (244, 242, 236), strength=1.5),
        parquet=textures.herringbone(rng, (188, 142, 94)),
        planks=textures.planks(rng, (168, 118, 78)),
        kitchen_tiles=textures.tiles(rng, ((226, 222, 212), (92, 106, 116)), size_m=1.3),
        carpet=textures.fabric(rng, (150, 158, 170), weave=12.0),
        living_wall=textures.plaster(rng, (226, 219, 204), strength=4.0),
        accent_wall=textures.wallpaper(rng, (58, 96, 100), (122, 160, 140), (226, 176, 94)),
        kitchen_wall=textures.plaster(rng, (238, 214, 160), strength=4.0),
        backsplash=textures.tiles(
            rng, ((244, 242, 236), (70, 130, 150), (226, 178, 120)), count=8, size_m=0.9
        ),
        bedroom_wall=textures.wallpaper(rng, (214, 200, 210), (168, 140, 166), (226, 150, 120)),
        study_wall=textures.plaster(rng, (186, 200, 184), strength=4.0),
        study_bricks=textures.bricks(rng, (172, 92, 70), (196, 188, 176)),
        sofa=textures.fabric(rng, (72, 96, 130), weave=9.0),
        armchair=textures.fabric(rng, (206, 138, 62), weave=9.0),
        cushions=(
            textures.stripes(rng, ((236, 226, 206), (200, 80, 62), (52, 84, 110))),
            textures.lattice(rng, (232, 220, 192), (190, 92, 60), size_m=0.22),
            textures.lattice(rng, (48, 92, 96), (230, 196, 120), size_m=0.2),
            textures.stripes(rng, ((88, 122, 104), (236, 228, 210), (224, 168, 84))),
        ),
        duvet=textures.lattice(rng, (224, 226, 232), (108, 136, 172), size_m=0.42),
        linen=textures.fabric(rng, (236, 232, 224), weave=4.0),
        curtain=(
            textures.stripes(rng, ((222, 206, 174), (206, 186, 150), (192, 120, 84)), size_m=0.8),
            textures.stripes(rng, ((150, 176, 178), (190, 206, 200), (102, 138, 146)), size_m=0.8),
        ),
        rugs=tuple(pictures.rug(rng, index) for index in range(4)),
        worktop=textures.stone(rng, (74, 76, 80)),
        cabinet=cabinet,
        cabinet_fronts=pictures.drawers(cabinet, rows=1, columns=5, knob=(214, 178, 98)),
        drawers=pictures.drawers(oak, rows=3, columns=2),
        wardrobe=pictures.drawers(pine, rows=1, columns=4),
        door=pictures.door_panel(rng),
        books=tuple(pictures.book_row(rng) for _ in range(6)),
        paintings=tuple(pictures.painting(rng, style) for style in range(14)),
        posters=(
            pictures.poster(rng, "ATLAS", "maps made together"),
            pictures.poster(rng, "LOOP", "been here before"),
            pictures.poster(rng, "SPLAT", "room for many"),
        ),
        clock=pictures.clock(),
        screen=pictures.screen(rng),
        television=pictures.painting(rng, 0, size=(288, 512)),
        window=pictures.sky(rng, emission=5.0),
        shade=textures.plain((255, 226, 176), emission=1.1),
        glow=textures.plain((255, 240, 214), emission=2.5),
        leaf=(
            textures.stripes(rng, ((58, 110, 62), (72, 132, 72), (96, 150, 84)), size_m=0.2),
            textures.stripes(rng, ((44, 92, 66), (120, 160, 92), (66, 116, 74)), size_m=0.25),
        ),
        terracotta=textures.plaster(rng, (188, 104, 72), strength=7.0),
        ceramics=(
            textures.stripes(rng, ((236, 232, 222), (58, 96, 150)), size_m=0.16),
            textures.plaster(rng, (220, 168, 78), strength=6.0),
            textures.lattice(rng, (240, 236, 226), (52, 120, 124), size_m=0.12),
        ),
        fruit=tuple(
            textures.plaster(rng, colour, strength=7.0)
            for colour in ((206, 60, 48), (236, 164, 46), (128, 166, 60))
        ),
        globe=pictures.painting(rng, 4),
    )
