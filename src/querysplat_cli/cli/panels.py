"""Which panel of `--help` each option is shown in."""

PANELS = {
    "Scene": ("scene", "scenes", "source", "target", "first", "second"),
    "Photos": (
        *("inputs", "film_frames", "holdout_every", "max_size", "max_views", "regions"),
        *("fit", "lens", "exposure", "overlays", "transients"),
        *("photos", "pictures"),
    ),
    "Quality": (
        *("quality", "budget", "tto", "tto_target", "tto_space", "steps", "lr", "space"),
        *("queries", "prune", "densify", "backdrop", "keep_everything"),
    ),
    "Cameras": (
        *("poses", "depth_maps", "metres_by", "refine_cameras", "holdout_cameras"),
        *("cameras", "colmap", "matcher"),
    ),
    "Model": (
        "preset",
        "encoder",
        "weights",
        "lpips",
        "lpips_net",
        "precision",
        "folder",
        "verify",
        "config",
        "changes",
    ),
    "Cases": ("splits", "protocol", "views", "scales", "cases", "shard", "splits_only", "merge"),
    "Rows and scores": ("sweep", "predictions", "name", "metrics", "fitted"),
    "Pictures": ("frames", "seconds", "fps", "size", "background", "query"),
    "Changes": (
        *("up", "scale", "clean", "prune_to", "no_backdrop", "crop", "remove", "keep_sphere"),
        *("points", "mesh", "text", "spz_version", "levels"),
    ),
    "Output": (
        *(
            "ply",
            "output",
            "out",
            "frame",
            "plot",
            "depth",
            "float_depth",
            "alpha",
            "save_pictures",
            "nerfbaselines",
            "resume",
            "dry_run",
            "samples_only",
            "tensorboard",
        ),
        *("with_photos", "view", "browser", "port", "force", "quiet", "json"),
    ),
    "Machine": ("device", "seed", "workers", "cluster"),
}
"""The options of each panel, by the names of their fields. A name means the same in every verb that has it.

Help pages show the panels in this order, and the options of a panel in theirs.
"""
