"""A Sphinx extension: leave out Thebe, which Jupyter Book always adds, twice, and which this book does not use."""


def without_thebe(app, pagename, templatename, context, doctree) -> None:
    """Take Thebe's scripts from a page; its settings name another host."""
    context["script_files"] = [
        script
        for script in context["script_files"]
        if "thebe" not in f"{script.filename} {script.attributes.get('body')}".lower()
    ]


def setup(app) -> dict:
    """Connect the extension."""
    app.connect("html-page-context", without_thebe, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
