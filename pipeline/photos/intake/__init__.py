"""Photos checked and prepared for the line: conversion, masks, bands, duplicates, groups of one camera."""
