#!/usr/bin/env bash
# tools/publish_documents.sh VERSION: add site/ to the branch gh-pages of origin, as folder VERSION, and list all versions.
set -euo pipefail
if git fetch --quiet --depth 1 origin gh-pages; then
    git worktree add --quiet pages FETCH_HEAD
else
    git worktree add --quiet --detach --no-checkout pages
    git -C pages switch --quiet --orphan gh-pages-new
fi
rm -rf "pages/$1"
cp -r site "pages/$1"
touch pages/.nojekyll
{
    echo '<!doctype html><meta charset="utf-8"><title>warpgs: documents</title><h1>warpgs: documents</h1><ul>'
    (cd pages && ls -d [0-9]*/) | sort --version-sort --reverse | sed 's|\(.*\)/|<li><a href="\1/">\1</a></li>|'
    echo '</ul>'
} > pages/index.html
git -C pages add --all
git -C pages -c user.name=warpgs -c user.email=warpgs@localhost commit --quiet --allow-empty --message "Documents of $1"
git -C pages push --quiet origin HEAD:gh-pages
git worktree remove --force pages
