"""The examples at the end of each verb's `--help`: a command line, and what it does."""

EXAMPLES = {
    "reconstruct": (
        ("reconstruct photos/ -o scene.ply", "a scene of a folder of photos"),
        ("reconstruct photos/ -o scene.ply --holdout-every 4", "and a score on every fourth photo, held out"),
        ("reconstruct clip.mp4 -o scene.ply", "a scene of a film"),
        ("reconstruct photos/ -o scene.ply --budget 20", "done after about 20 seconds"),
        ("reconstruct photos/ -o scene.ply --poses transforms.json", "with cameras of another tool"),
    ),
    "tto": (
        ("tto scene", "go on with the optimisation of a stored scene"),
        ("tto scene --quality high", "sharper at full screen; takes minutes"),
    ),
    "view": (
        ("view scene.ply", "the scene in the browser, its photos beside it"),
        ("view scene.ply --no-browser --port 8000", "only serve it, for a browser elsewhere by ssh -L"),
    ),
    "export": (
        ("export scene.ply", "scene.html, which opens from disk in any browser"),
        ("export scene.spz -o small.html --no-photos", "a small file, without the photos"),
    ),
    "render": (
        ("render scene.ply -o film.mp4", "a film along the input cameras"),
        ("render scene.ply -o frames/ --cameras orbit --frames 60", "60 pictures of a path around the scene"),
        ("render scene.ply -o frames/ --size 1280x720 --depth", "larger pictures, and their depth"),
    ),
    "eval": (
        ("eval scenes/ --splits-only -o evaluation/", "which cases there would be"),
        ("eval scenes/ --views 4 --cases 10 -o evaluation/", "ten cases of each split with four inputs"),
        ("eval scenes/ --predictions results/ --name theirs", "score the outputs of another method"),
    ),
    "poses": (
        ("poses scene transforms.json", "how far the scene's cameras are from given ones"),
        ("poses scene --colmap --plot cameras.svg", "compare with COLMAP, and draw both"),
    ),
    "convert": (
        ("convert scene.ply scene.spz", "a smaller file"),
        ("convert scene.ply scene.sog", "for PlayCanvas and SuperSplat"),
        ("convert scene.ply upright.ply --up z", "turn the axis that points up to -y"),
        ("convert scene.ply clean.ply --clean", "without floaters, and what that costs"),
        ("convert scene.ply points.ply --points", "a coloured point cloud"),
        ("convert scene.ply mesh.glb --mesh", "a coloured triangle mesh (needs querysplat[mesh])"),
        ("convert scene model/ --text", "a COLMAP model: the photos' lenses, and points"),
    ),
    "info": (
        ("info scene.ply", "count, extent, histograms, and what is odd"),
        ("info scene.ply --json --plot scene.png", "the same for programs, and drawn"),
    ),
    "inspect": (
        ("inspect scene", "attention, histograms and points, as pictures"),
        ("inspect scene --query 7 -o pictures/", "the attention of one query"),
    ),
    "demo": (
        ("demo", "photos of a made-up room, and their scene"),
        ("demo -o room --seed 7 --photos 20", "another room, and more photos"),
    ),
    "train": (
        ("train --config small -o training/", "a small model, in ten minutes of one core"),
        ("train --config compact --dry-run", "the memory and time that a training would take"),
        ("train --config compact -o training/ --resume", "go on with a training that was stopped"),
    ),
    "weights": (
        ("weights", "which files the official presets need, and which are here"),
        ("weights --weights downloads/ --verify", "check downloaded files, number by number"),
    ),
    "doctor": (
        ("doctor", "what this machine and this installation can do"),
        ("doctor --json", "the same for programs, and for bug reports"),
    ),
}
