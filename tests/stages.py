"""Stages and pages as the playground's tests want them."""

from clothgym.playground import server
from clothgym.playground.null import NullClient
from clothgym.playground.page import Page


def advanced(stage, frames):
    for _ in range(frames):
        stage.advance()
    return stage


def page(start="patch", **kwargs):
    gallery = server.Gallery(**kwargs)
    client = NullClient()
    return Page(client, gallery.open, gallery.titles, start), client
