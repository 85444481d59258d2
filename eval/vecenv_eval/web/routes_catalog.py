"""What there is to choose from: suites, tasks, policies."""

from __future__ import annotations

from fastapi import APIRouter

from vecenv_eval.panel import catalog
from vecenv_eval.web.models import Catalog, PolicyCatalog, PolicyRow, SuiteRow, TaskCatalog, TaskRow
from vecenv_eval.web.settings import ServeSettings


def catalog_router(settings: ServeSettings) -> APIRouter:
    """The routes of the catalogue."""
    router = APIRouter(prefix="/api", tags=["catalog"])

    @router.get("/catalog")
    def suites() -> Catalog:
        """Every suite."""
        return Catalog(suites=[SuiteRow(**vars(each)) for each in catalog.suites()])

    @router.get("/catalog/{suite:path}")
    def tasks(suite: str) -> TaskCatalog:
        """The tasks of a suite; its name may hold a slash."""
        return TaskCatalog(tasks=[TaskRow(**vars(each)) for each in catalog.tasks(suite)])

    @router.get("/policies")
    def policies() -> PolicyCatalog:
        """The policies that this server takes from clients."""
        rows = catalog.policies(trusted=settings.trust_clients)
        return PolicyCatalog(policies=[PolicyRow(name=name, description=text) for name, text in rows.items()])

    return router
